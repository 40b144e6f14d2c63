"""Proves that a run whose validation photos fare ever worse goes back to the scene that showed them best, also after it
was interrupted, and that the curve is measured with opacities that are not decayed.

Does not prove that real captures over-fit in this way: that is measured by `bench train`.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.train import checkpoint
from splatmill_worker.splat.train.loop import Hooks, train
from splatmill_worker.splat.train.snapshot import Snapshot
from splatmill_worker.splat.train.stopping import TAIL
from tests.support.training import first_engine, plan, split
from tests.support.training import gains_of_short_runs as gains_of_short_runs

STEPS = 100
BEST = 11  # a point of the curve, after which the scene gets worse


class Worsening:
    """An engine that moves every Gaussian at random after each step beyond BEST, the farther the later."""

    def __init__(self, until: int) -> None:
        self._engine, self._until = first_engine(), until

    def __getattr__(self, name: str) -> Any:
        return getattr(self._engine, name)

    def train_photo(self, *args: Any, step: int, **named: Any) -> Any:
        result = self._engine.train_photo(*args, step=step, **named)
        if BEST < step <= self._until:
            parameters = self._engine.parameters()
            random = torch.Generator().manual_seed(step)
            parameters["means"] += (
                0.02 * (step - BEST) * torch.randn(parameters["means"].shape, generator=random)
            )
            self._engine.replace(parameters, *self._engine.moments())
        return result


def course() -> Plan:
    made = plan(STEPS, stops_when_flat=True, validation=2, densify=False)
    return replace(made, schedule=replace(made.schedule, resolution=((0, 1),)))


def test_a_run_that_gets_worse_goes_back_to_its_best_scene_and_ends() -> None:
    views, held_out = split()
    trained = train(Worsening(until=40), views, held_out, course(), extent=1.1)
    scores = {
        point.step: point.validation_psnr for point in trained.curve if point.validation_psnr is not None
    }
    assert list(scores) == [4, 11, 22, 40]
    assert trained.stopped.startswith(
        f"more steps over-fit, so training went back to the scene after {BEST} steps; "
    )
    assert trained.steps == (1.0 + TAIL) * 40 < STEPS
    best = next(point for point in trained.curve if point.step == BEST)
    assert best.psnr is not None
    assert trained.held_out is not None
    assert trained.held_out.psnr > best.psnr  # by the steps after it, at falling rates and on all photos


def test_a_resumed_run_goes_back_too(tmp_path: Path) -> None:
    views, held_out = split()
    whole = train(Worsening(STEPS), views, held_out, course(), extent=1.1)
    kept: list[Snapshot] = []
    hooks = Hooks(checkpoint=kept.append, checkpoint_seconds=0.0)
    train(Worsening(STEPS), views, held_out, course(), extent=1.1, hooks=hooks)
    checkpoint.save(tmp_path, next(snapshot for snapshot in kept if snapshot.state.step == 30))
    resumed = train(
        Worsening(STEPS), views, held_out, course(), extent=1.1, resume_from=checkpoint.load(tmp_path)
    )
    assert f"went back to the scene after {BEST} steps" in resumed.stopped
    assert (resumed.stopped, resumed.steps) == (whole.stopped, whole.steps)
    assert torch.equal(resumed.gaussians.means, whole.gaussians.means)


def test_points_of_the_curve_lie_half_way_to_the_next_densification() -> None:
    views, held_out = split()
    trained = train(first_engine(), views, held_out, plan(300), extent=1.1)
    # Densified after 60 steps and each 40, below 210: the shares 0.22 and 0.6, at 66 and 180, wait until 80 and 200.
    assert [point.step for point in trained.curve] == [12, 33, 80, 120, 200, 240, 300]
