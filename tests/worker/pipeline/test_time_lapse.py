"""Proves that a model keeps snapshots of its training, that these go on after a cancelled attempt, and that their time
is bounded and counted.

Does not prove how they look; tests/worker/splat/formats proves what the files hold.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from splatmill.schema import TrainOptions
from splatmill_worker import pipeline
from splatmill_worker.pipeline import time_lapse
from splatmill_worker.pipeline.time_lapse import MOST, SHARE, TAKEN_AT, TimeLapse
from splatmill_worker.scene import Normalization
from splatmill_worker.splat.formats import compressed_ply
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.report.export import ExportWorld
from tests.support import still_life

WORLD = ExportWorld(Normalization(2.0, np.array([1.0, 0.0, 0.0])), np.zeros(3))


class Holder:
    """An engine that holds some Gaussians."""

    def __init__(self, count: int = 10) -> None:
        nothing = torch.zeros(count, 3)
        turns = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1)
        self.held = Gaussians(
            nothing + 5.0, nothing - 3.0, turns, torch.ones(count), torch.zeros(count, 16, 3)
        )
        self.count = count

    def parameters(self) -> dict[str, torch.Tensor]:
        return {
            name: getattr(self.held, name)
            for name in ("means", "log_scales", "quats", "logit_opacities", "sh")
        }


def run_at(engine: Holder, progress: float, seconds: float, step: int) -> Any:
    """What is asked of a run that holds a scene."""
    return SimpleNamespace(
        engine=engine,
        progress=progress,
        clock=SimpleNamespace(seconds=seconds),
        state=SimpleNamespace(step=step),
    )


def trained(capture: Path, work: Path, cancelled: Callable[[], bool] = lambda: False) -> pipeline.Outcome:
    options = TrainOptions.model_validate(
        {"steps": 100, "seed": 1, "max_gaussians": 2000, "time_lapse": "on"}
    )
    return pipeline.run(capture, work, options, lambda _: None, cancelled)


@pytest.mark.slow
def test_a_model_keeps_snapshots_also_over_two_attempts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time_lapse, "SHARE", 1.0)  # a training of 0.2 s has hardly time for one
    capture = still_life.posed_capture(tmp_path / "capture")
    kept = tmp_path / "work" / "time_lapse"
    cancelled = trained(capture, tmp_path / "work", lambda: len(list(kept.glob("*.json"))) >= 2)
    assert cancelled.ended == "cancelled"
    first = (kept / "000.ply").read_bytes()
    outcome = trained(capture, tmp_path / "work")
    report = json.loads((outcome.out / "report.json").read_text())
    rows: list[dict[str, Any]] = report["time_lapse"]
    assert 3 <= len(rows) <= MOST
    assert [row["file"] for row in rows] == [f"time_lapse/{i:03d}.ply" for i in range(len(rows))]
    steps = [row["step"] for row in rows]
    assert steps == sorted(set(steps))
    assert (outcome.out / "time_lapse" / "000.ply").read_bytes() == first
    assert report["seconds"]["time_lapse"] > 0
    last = compressed_ply.read(outcome.out / rows[-1]["file"]).gaussians
    assert last.count == rows[-1]["shown"] <= rows[-1]["gaussians"]
    # The snapshots lie in the world of the model: around what the cameras look at.
    center = np.median(last.means.numpy(), axis=0)
    assert np.linalg.norm(center - still_life.scene().points.mean(axis=0)) < 1.0


@pytest.mark.parametrize(("cost", "fewest", "most"), [(0.0, MOST, MOST), (0.2, 4, 6), (100.0, 1, 1)])
def test_snapshots_take_a_hundredth_of_the_training(
    tmp_path: Path, cost: float, fewest: int, most: int
) -> None:
    now = 0.0
    steps: Iterator[int] = itertools.count(1)

    def clock() -> float:
        return now

    class Slow(Holder):
        def parameters(self) -> dict[str, torch.Tensor]:
            nonlocal now
            now += cost
            return super().parameters()

    lapse = TimeLapse(tmp_path, WORLD, anew=True, clock=clock)
    for _ in range(1000):  # 100 seconds of training
        now += 0.1
        progress = next(steps) / 1000
        run = run_at(Slow(), progress, now, round(1000 * progress))
        if lapse.is_due(run):
            lapse.observe(run)
    taken = len(list(tmp_path.glob("*.ply")))
    assert fewest <= taken <= most
    assert lapse.seconds <= max(SHARE * 100.0, cost) + 1e-9


def test_the_snapshots_after_a_checkpoint_are_taken_again(tmp_path: Path) -> None:
    lapse = TimeLapse(tmp_path, WORLD, anew=True)
    for step in (10, 20, 30):
        lapse.observe(run_at(Holder(), step / 100, 1.0, step))
    again = TimeLapse(tmp_path, WORLD, anew=False)
    again.observe(run_at(Holder(5), 0.2, 1.0, 20))
    (tmp_path / "out").mkdir()
    rows = again.publish(tmp_path / "out")
    assert [(row["step"], row["gaussians"]) for row in rows] == [(10, 10), (20, 5)]
    assert sorted(path.name for path in (tmp_path / "out" / "time_lapse").iterdir()) == ["000.ply", "001.ply"]
    position = compressed_ply.read(tmp_path / "out" / "time_lapse" / "000.ply").gaussians.means[0].numpy()
    assert position == pytest.approx([2.0, 2.5, 2.5], abs=1e-3), "(p - translation) / scale"
    TimeLapse(tmp_path, WORLD, anew=True)
    assert not list(tmp_path.glob("*.ply"))


def test_snapshots_are_densest_at_the_beginning() -> None:
    gaps = np.diff(TAKEN_AT)
    assert len(TAKEN_AT) == MOST
    assert (np.diff(gaps) > 0).all()
    assert 0 < TAKEN_AT[0] < TAKEN_AT[-1] < 1
