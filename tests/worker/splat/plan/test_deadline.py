"""Proves how much of the time of a whole job its training gets, and what the plan says of it.

Does not prove that a job ends in its time: what storing takes is assumed. The benchmarks record it.
"""

import pytest

from splatmill_worker.pipeline.planning import overrun
from splatmill_worker.splat.plan.deadline import (
    COMPARED_STEPS,
    EVALUATED_STEPS,
    STORING,
    STORING_STEPS,
)
from splatmill_worker.splat.plan.evaluated import curve_views
from tests.support.plans.facts import changed, planned


def test_training_gets_what_is_left_but_for_measuring_and_storing() -> None:
    plan = planned(changed(seconds_left=100.0), within="2m")
    seconds = plan.schedule.budget.seconds
    assert seconds is not None
    step = seconds / plan.schedule.expected_steps
    points = curve_views(7, 43, int(100.0 / step))
    views = (len(points.shares) - 1) * (points.held_out + points.training) + 7 + 22
    besides = (EVALUATED_STEPS * views + COMPARED_STEPS * 43) * step + max(STORING, STORING_STEPS * step)
    assert seconds + besides == pytest.approx(100.0, rel=1e-3)
    assert "2m00s for the whole job, 100 s are left" in plan.reasons["schedule"]
    assert plan.schedule.annealing.boost is None  # as under any time budget, the run measures its steps
    shorter = planned(changed(seconds_left=50.0), within="2m").schedule.budget.seconds
    assert shorter == pytest.approx(seconds - 50.0, abs=5.0)


def test_the_shorter_of_two_times_holds() -> None:
    facts = changed(seconds_left=100.0)
    assert planned(facts, within="2m", time_budget=20).schedule.budget.seconds == 20
    assert planned(facts, within="2m", time_budget=1000) == planned(facts, within="2m", time_budget=500)
    assert planned(facts, within="2m", steps=50).schedule.budget.steps == 50


@pytest.mark.parametrize("left", [2.0, -30.0])
def test_where_the_cameras_have_left_too_little_each_photo_is_shown_once(left: float) -> None:
    plan = planned(changed(seconds_left=left), within="1m")
    assert plan.schedule.expected_steps == 43
    assert "ends later than asked" in plan.reasons["schedule"]


def test_lpips_is_left_out_and_nothing_is_doubled() -> None:
    plan = planned(changed(seconds_left=100.0), within="2m")
    assert not plan.lpips
    assert plan.schedule.longest is None


def test_a_job_that_ends_later_than_asked_says_so() -> None:
    facts = changed(seconds_left=0.1)
    late = overrun(facts, planned(facts, within="1m"))
    assert late is not None
    assert "left 0 s of the time for the whole job" in late
    enough = changed(seconds_left=50.0)
    assert overrun(enough, planned(enough, within="1m")) is None
    assert overrun(changed(), planned(steps=500)) is None
