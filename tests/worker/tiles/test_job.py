"""A job in tiles, unit after unit in one process: which units are done, what its events say of them, and what another
attempt does again.

Does not prove that others find the tiles: tests/service/test_tiles.py does.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from splatmill.schema import (
    CamerasEvent,
    Event,
    JobState,
    LogEvent,
    MetricEvent,
    PreviewEvent,
    ProgressEvent,
    StateEvent,
    UnitEvent,
)
from splatmill_worker import synthetic
from splatmill_worker.pipeline import Outcome, live
from splatmill_worker.sfm.mapping import clusters
from splatmill_worker.tiles import job
from splatmill_worker.tiles.folder import PlanFolder
from splatmill_worker.tiles.stages import Context, run_unit
from tests.support import still_life
from tests.support.plans.tiles import TWO_TILES
from tests.worker.audience import Audience

pytestmark = pytest.mark.slow


class Play(job.Nobody):
    """Plays other workers, and records what they are asked.

    at_offer: called with the folder once, before any tile is begun.
    has: tiles that they have.
    """

    def __init__(self, at_offer: Callable[[PlanFolder], None] = lambda folder: None, *has: str) -> None:
        self.has, self.offered, self.stores, self.ended = list(has), list[str](), list[str](), 0
        self.forgotten = list[str]()
        self._at_offer = at_offer

    def begin(self, folder: PlanFolder) -> None:
        self._folder = folder

    def stored(self, output: Path) -> None:
        self.stores.append(output.name.rpartition("-")[0])

    def offer(self, tiles: Sequence[str]) -> None:
        if not self.offered:
            self._at_offer(self._folder)
        self.offered += [name for name in tiles if name not in self.offered]

    def take_back(self, tile: str) -> bool:
        return tile not in self.has

    def gather(self, folder: PlanFolder) -> None:
        if self.has and "tile-1" in folder.states():
            with folder.claimed(self.has.pop()) as run:
                run_unit(Context(folder, run, lambda event: None, lambda: False))

    def forget(self, outputs: Sequence[Path]) -> None:
        self.forgotten += [path.name.rpartition("-")[0] for path in outputs]

    def end(self) -> None:
        self.ended += 1


def run(
    tmp_path: Path,
    others: job.Others,
    cancelled: Callable[[list[Event]], bool] = lambda events: False,
    onlookers: Audience | None = None,
) -> tuple[Outcome, list[Event]]:
    """The outcome and the events of a run in `tmp_path`, which may be one more there."""
    capture, workdir = tmp_path / "capture", tmp_path / "run"
    if not capture.exists():
        still_life.posed_capture(capture)
    workdir.mkdir(exist_ok=True)
    events: list[Event] = []

    def emit(event: Event) -> None:
        events.append(event)
        if isinstance(event, PreviewEvent | CamerasEvent):
            assert (workdir / event.path).is_file()

    outcome = job.run(
        capture, workdir, TWO_TILES, emit, lambda: cancelled(events), onlookers=onlookers, others=others
    )
    return outcome, events


def test_units_are_done_in_order_and_stored_and_those_of_others_are_waited_for(tmp_path: Path) -> None:
    others = Play(lambda folder: None, "tile-2")
    outcome, events = run(tmp_path, others)
    assert outcome.ended == "succeeded"
    assert (others.offered, others.stores, others.ended) == (
        ["tile-1", "tile-2", "seam-1", "seam-2"],
        ["photos", "cameras", "cameras", "coarse", "tile-1", "seam-1", "seam-2"],
        1,
    )
    assert [event.state for event in events if isinstance(event, StateEvent)] == [
        JobState.sfm,
        JobState.training,
        JobState.exporting,
    ]
    told = [event for event in events if isinstance(event, UnitEvent)]
    both = ("running", "done")
    assert [(event.unit, event.state) for event in told] == [
        *((unit, state) for unit in ("photos", "cameras", "coarse", "tile-1") for state in both),
        *(("tile-2", state) for state in ("elsewhere", "done")),
        *((unit, state) for unit in ("seam-1", "seam-2", "scene") for state in both),
    ]
    assert {event.tiles for event in told} == {2}
    for event in told:
        assert (event.seconds is not None) == (event.state == "done")
        assert (event.gaussians is not None) == (
            event.state == "done" and event.unit not in ("photos", "cameras")
        )
    notes = {event.note for event in events if isinstance(event, ProgressEvent)}
    assert "tile 1 of 2" in notes
    assert "seam 2 of 2" in notes
    assert "tile 2 of 2" not in notes
    compared = [event for event in events if isinstance(event, ProgressEvent) and event.stage == "evaluation"]
    shown = [(event.done, event.total) for event in compared if (event.note or "").startswith("whole scene")]
    assert shown == [(1, 3), (2, 3), (3, 3), *((done, 6) for done in range(1, 7))], "then where tiles meet"
    report = json.loads((outcome.out / "report.json").read_text())
    assert report["curve"][-1]["step"] == 150
    assert (outcome.out / "model.ply").stat().st_size > 0
    again, events = run(tmp_path, Play())
    assert (again.ended, events) == ("succeeded", [])


@pytest.mark.parametrize(("failed", "mapped"), [(False, False), (True, False), (False, True)])
def test_features_and_matches_of_others_are_waited_for_and_used(
    tmp_path: Path, failed: bool, mapped: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Until the cameras are there. failed: the features that others have, which later units find then. mapped: the
    photos have clusters."""
    if mapped:
        monkeypatch.setattr(clusters, "CLUSTER_PHOTOS", 8)
    synthetic.capture(tmp_path / "capture" / "images", 16, 240, 180, samples=1)

    class Has(Play):
        def gather(self, folder: PlanFolder) -> None:
            if self.has and f"{self.has[0].partition('-')[0]}-1" in folder.states():
                with folder.claimed(self.has.pop(0)) as run:
                    if failed:
                        run.fail("Its decoder ended.", "")
                    else:
                        run_unit(Context(folder, run, lambda event: None, lambda: False))

    theirs = ["features-2", *([] if failed else ["matches-2"]), *(["mapping-2"] if mapped else [])]
    others = Has(lambda folder: None, *theirs)
    outcome, events = run(tmp_path, others, lambda events: "cameras" in others.stores)
    assert outcome.ended == "cancelled"
    matches = [] if failed else ["matches-1", "matches-2"]  # what failed is not known elsewhere
    mapping = ["mapping-1", "mapping-2"] if mapped else []
    assert others.offered == ["features-1", "features-2", *matches, *mapping]
    told = [(event.unit, event.state) for event in events if isinstance(event, UnitEvent)]
    both, last = ("running", "done"), "running" if failed else "elsewhere"
    assert told == [
        *((unit, state) for unit in ("photos", "features-1") for state in both),
        *(("features-2", state) for state in ("elsewhere", "failed" if failed else "done")),
        *((unit, state) for unit in ("pairs", "matches-1") for state in both),
        *(("matches-2", state) for state in (last, "done")),
        *(("mapping-1", state) for state in both if mapped),
        *(("mapping-2", state) for state in ("elsewhere", "done") if mapped),
        *(("cameras", state) for state in both),
    ]
    progress = [event for event in events if isinstance(event, ProgressEvent)]
    waits = [(event.stage, event.done, event.total) for event in progress if "waiting" in (event.note or "")]
    assert waits == [
        (stage, 2, 2)
        for stage in ("features", *([] if failed else ["matching"]), *(["mapping"] if mapped else []))
    ]
    if mapped:
        assert "mapping 1 of 2: part 1 of 2, photos placed" in {event.note for event in progress}
    assert "features 1 of 2: still_0001.jpg" in {event.note for event in progress}
    assert sum(event.stage == "images" and event.note == "still_0001.jpg" for event in progress) == 1
    parts = ("features", "matches", "mapping")
    names = [f"{part}-{number}" for part in parts for number in (1, 2)]
    assert sorted(others.forgotten) == sorted(["pairs", *names])
    units = tmp_path / "run" / "tiles" / "units"
    assert {path.name.rpartition("-")[0] for path in units.glob("*") if path.is_dir()} == {
        "photos",
        "cameras",
    }
    # An attempt that ends before it has removed them leaves that to the next one.
    left = next(units.glob("cameras-*")).with_name(
        next(units.glob("photos-*")).name.replace("photos", "pairs")
    )
    left.mkdir()
    again = Play()
    run(tmp_path, again, lambda events: bool(again.forgotten))
    assert again.forgotten == others.forgotten
    # With the cameras of another job on the capture, none is looked for.
    shutil.rmtree(tmp_path / "run" / "tiles")
    _, events = run(tmp_path, (known := Play()), lambda events: "cameras" in known.stores)
    told = [(event.unit, event.state) for event in events if isinstance(event, UnitEvent)]
    assert told == [(unit, state) for unit in ("photos", "cameras") for state in both]
    assert known.offered == []


def test_a_failed_tile_is_said_and_the_scene_is_made_without_it_also_where_somebody_looks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live, "INTERVAL", 0.0)
    monkeypatch.setattr(live, "SHARE", 1e9)

    def fail(folder: PlanFolder) -> None:
        with folder.claimed("tile-1") as run:
            run.fail("Nothing shows it.", "")

    others, audience = Play(fail), Audience()
    outcome, events = run(tmp_path, others, onlookers=audience)
    assert audience.shown[-1][1].step == 50 + 50, "with the coarse model in the cell of tile 1"
    said = [event.message for event in events if isinstance(event, LogEvent) and event.level == "warning"]
    assert any("Tile 1 of 2 failed" in message and "Nothing shows it." in message for message in said)
    report = json.loads((outcome.out / "report.json").read_text())
    assert any("Tile 1 of 2 failed" in warning for warning in report["warnings"])
    told = [event.state for event in events if isinstance(event, UnitEvent) and event.unit == "tile-1"]
    assert told == ["failed"]
    assert others.offered == ["tile-1", "tile-2"], "nobody else knows that tile 1 failed"
    assert not any("0 Gaussians" in event.message for event in events if isinstance(event, LogEvent))
    assert report["curve"][-1]["step"] == 50 + 50


def test_a_tile_without_its_last_steps_is_said_and_used_as_it_is(tmp_path: Path) -> None:
    def fail(folder: PlanFolder) -> None:
        for name in ("tile-1", "tile-2"):
            with folder.claimed(name) as run:
                run_unit(Context(folder, run, lambda event: None, lambda: False))
        with folder.claimed("seam-1") as run:
            run.fail("It diverged.", "")

    outcome, _ = run(tmp_path, Play(fail))
    report = json.loads((outcome.out / "report.json").read_text())
    (warning,) = (each for each in report["warnings"] if "Tile 1 of 2" in each)
    assert "lacks its last steps" in warning
    assert "It diverged." in warning
    assert report["curve"][-1]["step"] == 50 + 40 + 50


def test_a_coarse_training_that_was_interrupted_continues(tmp_path: Path) -> None:
    def measured(events: list[Event]) -> set[int]:
        return {event.step for event in events if isinstance(event, MetricEvent)}

    others = Play()
    outcome, events = run(tmp_path, others, lambda events: len(measured(events)) >= 3)
    assert (outcome.ended, others.stores, others.ended) == ("cancelled", ["photos", "cameras", "cameras"], 1)
    before = measured(events)
    outcome, events = run(tmp_path, Play())
    assert outcome.ended == "succeeded"
    assert max(before) < min(measured(events))
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == ["out", "sfm", "tiles"]


def test_a_checkpoint_of_another_plan_is_not_continued(tmp_path: Path) -> None:
    def measured(events: list[Event]) -> list[int]:
        return [event.step for event in events if isinstance(event, MetricEvent)]

    outcome, events = run(tmp_path, Play(), lambda events: len(measured(events)) >= 3)
    (tmp_path / "run" / "plan.json").unlink()
    outcome, again = run(tmp_path, Play())
    assert outcome.ended == "succeeded"
    assert min(measured(again)) == min(measured(events))


def test_a_job_whose_coarse_model_is_there_is_in_training(tmp_path: Path) -> None:
    def states(events: list[Event]) -> list[JobState]:
        return [event.state for event in events if isinstance(event, StateEvent)]

    others = Play()
    run(tmp_path, others, lambda events: "coarse" in others.stores)
    outcome, events = run(tmp_path, Play())
    assert (outcome.ended, states(events)) == ("succeeded", [JobState.training, JobState.exporting])


def test_given_cameras_with_points_leave_nothing_that_was_recovered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def without(context: Context) -> None:
        run_unit(context)
        if context.run.name == "cameras":
            shutil.rmtree(context.run.path / "sfm")  # the points, which these photos had to give

    monkeypatch.setattr(job, "run_unit", without)
    outcome, _ = run(tmp_path, Play())
    assert outcome.ended == "succeeded"
