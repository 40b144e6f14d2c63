"""What a job in tiles shows while it runs: the coarse model, then each tile in its cell as it is trained.

Does not prove how it reaches a browser (tests/browser).
"""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import pytest
import torch

from splatmill.schema import Event, UnitEvent
from splatmill_worker.pipeline import live
from splatmill_worker.splat.formats import ply
from splatmill_worker.tiles import coarse_model, job
from splatmill_worker.tiles.folder import PlanFolder, facts_of
from splatmill_worker.tiles.stages import Context, run_unit
from tests.support import still_life
from tests.support.plans.tiles import TWO_TILES
from tests.worker.audience import Audience, snapshot

pytestmark = pytest.mark.slow


class HasSecond(job.Nobody):
    """Plays another worker, which trains the second tile."""

    has = True

    def take_back(self, tile: str) -> bool:
        return not (self.has and tile == "tile-2")

    def gather(self, folder: PlanFolder) -> None:
        if self.has and "tile-1" in folder.states():
            self.has = False
            with folder.claimed("tile-2") as run:
                run_unit(Context(folder, run, lambda event: None, lambda: False))


def test_tiles_are_shown_as_they_are_trained_and_the_coarse_model_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live, "INTERVAL", 0.0)
    monkeypatch.setattr(live, "SHARE", 1e9)
    capture = still_life.posed_capture(tmp_path / "capture")
    audience, events = Audience(), list[Event]()
    began: dict[str, int] = {}

    def emit(event: Event) -> None:
        events.append(event)
        if isinstance(event, UnitEvent) and event.state == "running":
            began[event.unit] = len(audience.shown)

    outcome = job.run(
        capture, tmp_path, TWO_TILES, emit, lambda: False, onlookers=audience, others=HasSecond()
    )
    assert outcome.ended == "succeeded"
    steps = [event.step for _, event in audience.shown]
    assert steps == sorted(steps)
    shown = {
        unit: audience.shown[begin:end]
        for unit, (begin, end) in zip(
            began, itertools.pairwise([*began.values(), len(audience.shown)]), strict=True
        )
    }
    assert not shown["photos"]
    for unit in ("coarse", "tile-1", "seam-1", "seam-2"):
        assert len(shown[unit]) > 2, "between its steps too"
    coarse, tile = shown["coarse"][-1][1], shown["tile-1"][0][1]
    assert coarse.step <= 50 <= tile.step
    folder = PlanFolder.open(tmp_path / "tiles")
    facts = {name: facts_of(end.path) for name, end in folder.ended().items() if end.path is not None}
    trained = ("coarse", "tile-1", "tile-2", "seam-1", "seam-2")
    assert audience.shown[-1][1].step == sum(facts[name]["steps"] for name in trained)
    assert audience.shown[-1][1].gaussians == facts["scene"]["gaussians"]
    assert audience.shown[-1][1].seconds == pytest.approx(facts["scene"]["train_seconds"], abs=0.1)
    seconds = json.loads((outcome.out / "report.json").read_text())["seconds"]
    assert seconds["live"] > 0
    assert min(seconds.values()) >= 0
    # The last one before the scene is written is the model, without what depends on the view.
    model, last = ply.read(outcome.out / "model.ply").gaussians, snapshot(audience.shown[-1][0], tmp_path)
    assert last.degree == 0
    assert abs(last.count - model.count) <= 0.05 * model.count, "invisible ones are left out"
    for name in ("mean", "std"):
        ours, theirs = (getattr(each.means, name)(dim=0) for each in (last, model))
        assert torch.allclose(ours, theirs, atol=0.02 * float(model.means.std(dim=0).max())), name
    # While the first tile is trained, the cell of the second has the coarse model.
    path = folder.ended()["coarse"].path
    assert path is not None
    model_before = coarse_model.read(path)
    second, world = model_before.cells[1], model_before.world.normalization

    def in_second(data: bytes) -> int:
        return int(second.holds(world.points(snapshot(data, tmp_path).means.double().numpy())).sum())

    counts = [in_second(data) for data, _ in (shown["coarse"][-1], *shown["tile-1"])]
    assert max(counts) - min(counts) <= 0.02 * max(counts)
    assert in_second(shown["seam-1"][0][0]) != counts[-1], "of which the other worker has trained a tile"
    unseen = Audience(there=False)
    job.run(capture, tmp_path / "again", TWO_TILES, events.append, lambda: False, onlookers=unseen)
    assert not unseen.shown
