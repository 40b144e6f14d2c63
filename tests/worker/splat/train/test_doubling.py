"""Proves that a budget is doubled where the last doubling of its steps gained enough, up to the longest that the plan
allows, at the learning rates of the longer run, and that an interrupted run continues as one that was not.

Does not prove that a longer run gains on real captures: worker/bench/decisions.md has what was measured.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
import torch

from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.plan.rates import Annealing, boost_of
from splatmill_worker.splat.train import checkpoint, observers
from splatmill_worker.splat.train.loop import Hooks, train
from splatmill_worker.splat.train.run import TrainingRun
from splatmill_worker.splat.train.snapshot import Snapshot
from tests.support.training import first_engine, plan, split
from tests.support.training import gains_of_short_runs as gains_of_short_runs


def course(least: float = 0.0, longest: int | None = 400, steps: int = 100) -> Plan:
    made = plan(steps, stops_when_flat=True, least_gain=least, validation=2, densify=False)
    annealing = Annealing(boost=boost_of(steps))
    return replace(
        made, schedule=replace(made.schedule, resolution=((0, 1),), longest=longest, annealing=annealing)
    )


def test_a_budget_is_doubled_while_that_gains_up_to_the_longest() -> None:
    views, held_out = split()
    trained = train(first_engine(), views, held_out, course(), extent=1.1)
    # Doubled at 60 % of 100 and of 200 steps, where the points that decide end.
    assert [point.step for point in trained.curve] == [4, 11, 22, 40, 60, 80, 120, 160, 240, 320, 400]
    assert [point.step for point in trained.curve if point.validation_psnr is not None][-1] == 240
    assert trained.stopped.startswith("the budget is spent; the last doubling gained ")


@pytest.mark.parametrize(
    ("least", "said", "end", "bounds"), [(0.0, [400], 400, 120), (50.0, [400, 60], 60, 40)]
)
def test_what_is_done_and_what_is_left_never_go_back(
    least: float, said: list[int], end: int, bounds: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The number of steps is that of the longest run at first, and what it becomes once that is decided."""
    monkeypatch.setattr(observers, "PROGRESS_SECONDS", 0.0)
    reports: list[observers.TrainingProgress] = []
    views, held_out = split()
    train(first_engine(), views, held_out, course(least), extent=1.1, hooks=Hooks(progress=reports.append))
    assert (len(reports), reports[-1].step, reports[-1].steps) == (end, end, end)
    assert list(dict.fromkeys(report.steps for report in reports)) == said
    # They are said to be a bound for as long as the run may end earlier.
    assert [report.at_most for report in reports] == [True] * bounds + [False] * (end - bounds)
    for before, after in pairwise(reports):
        assert after.step / after.steps >= before.step / before.steps
        assert after.steps - after.step <= before.steps - before.step


@pytest.mark.parametrize(("least", "longest", "steps"), [(0.0, None, 100), (0.0, 150, 150), (50.0, 400, 60)])
def test_a_budget_stays_where_the_plan_says_so_or_little_was_gained(
    least: float, longest: int | None, steps: int
) -> None:
    views, held_out = split()
    assert train(first_engine(), views, held_out, course(least, longest), extent=1.1).steps == steps


def test_a_reached_target_ends_a_run_that_might_be_doubled() -> None:
    views, held_out = split()
    reached = replace(course(), target_psnr=5.0)
    trained = train(first_engine(), views, held_out, reached, extent=1.1)
    assert (trained.steps, trained.stopped[:21]) == (4, "the validation photos")


def test_the_rates_are_those_of_the_longer_run() -> None:
    run = TrainingRun(first_engine(), course(steps=2000, longest=6000), split()[0], 1.1)
    before = run.rates(0.0)
    for steps in (4000, 6000):
        assert run.double()
        assert run.state.budget.steps == steps
        after = run.rates(0.0)
        assert after.log_scales == pytest.approx(before.log_scales * (2000 / steps) ** 0.5)
        assert after.logit_opacities == pytest.approx(before.logit_opacities * (2000 / steps) ** 0.25)
    assert not run.double()
    run.shorten(0.1)
    assert run.rates(0.0).log_scales == before.log_scales


def test_an_interrupted_run_is_doubled_too(tmp_path: Path) -> None:
    views, held_out = split()
    kept: list[Snapshot] = []
    hooks = Hooks(checkpoint=kept.append, checkpoint_seconds=0.0)
    whole = train(first_engine(), views, held_out, course(), extent=1.1, hooks=hooks)
    for step in (50, 100, 300):  # before it is doubled, once it was, and twice
        checkpoint.save(tmp_path, next(snapshot for snapshot in kept if snapshot.state.step == step))
        resumed = train(
            first_engine(), views, held_out, course(), extent=1.1, resume_from=checkpoint.load(tmp_path)
        )
        assert (resumed.stopped, resumed.steps) == (whole.stopped, whole.steps)
        assert torch.equal(resumed.gaussians.means, whole.gaussians.means)
