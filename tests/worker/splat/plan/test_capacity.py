"""Proves how many steps and Gaussians a plan allows: by budget, speed, photos, memory and options.

Does not prove that a run keeps to its time; tests/worker/splat/train does.
"""

from __future__ import annotations

import pytest

from splatmill_worker.splat.plan.facts import Speed
from splatmill_worker.splat.plan.plan import Plan
from tests.support.facts import changed, planned


@pytest.mark.parametrize(("preset", "steps"), [("draft", 1000), ("balanced", 3000), ("quality", 10_000)])
def test_without_a_budget_the_preset_gives_the_steps(preset: str, steps: int) -> None:
    plan = planned(preset=preset)
    assert plan.schedule.budget.steps == plan.schedule.expected_steps == steps
    assert f"the preset {preset} allows {steps} steps" in plan.reasons["budget"]


def test_a_target_alone_gets_the_steps_of_the_best_preset() -> None:
    assert planned(target_psnr=30.0, preset="draft").schedule.budget.steps == 10_000
    assert planned(target_psnr=30.0, steps=700).schedule.budget.steps == 700


def test_more_time_allows_more_steps_and_more_gaussians() -> None:
    plans = [planned(time_budget=seconds) for seconds in (5, 10, 20, 40, 80)]
    counts = [plan.max_gaussians for plan in plans]
    assert counts == sorted(set(counts))
    assert [plan.schedule.budget.seconds for plan in plans] == [5, 10, 20, 40, 80]
    slow = planned(changed(speed=Speed(2.6e-6, 9e-6)), time_budget=80)
    assert slow.max_gaussians < plans[-1].max_gaussians


def test_the_expected_steps_take_the_time_of_the_budget() -> None:
    plan = planned(time_budget=60)
    step = Speed(2.6e-8, 9e-8).step(270 * 480, plan.max_gaussians)
    assert step * plan.schedule.expected_steps == pytest.approx(60, rel=1e-3)


def test_steps_cut_a_time_budget_short() -> None:
    plan = planned(time_budget=60, steps=200)
    assert plan.schedule.expected_steps == 200
    assert (plan.schedule.budget.steps, plan.schedule.budget.seconds) == (200, 60)
    assert "of which the option steps asks for 200" in plan.reasons["schedule"]


def test_fewer_gaussians_than_a_budget_pays_for_leave_time_for_more_steps() -> None:
    few, many = planned(time_budget=60, max_gaussians=12_000), planned(time_budget=60)
    assert few.schedule.expected_steps > many.schedule.expected_steps


def test_gaussians_follow_the_root_of_the_steps_up_to_what_photos_resolve() -> None:
    short, long = planned(steps=600), planned(steps=2400)
    assert long.max_gaussians == pytest.approx(2 * short.max_gaussians, rel=1e-3)
    assert "600 steps" in short.reasons["max_gaussians"]
    endless = planned(steps=1_000_000)
    assert endless.max_gaussians == round(43 * 270 * 480 / 50)
    assert "43 photos of 129600 pixels" in endless.reasons["max_gaussians"]


def test_memory_bounds_the_gaussians() -> None:
    plan = planned(max_memory=400_000_000, steps=30_000)
    assert plan.max_gaussians == Plan.gaussians_within(400_000_000) < planned(steps=30_000).max_gaussians
    assert "Memory" in plan.reasons["max_gaussians"]
    assert Plan.gaussians_within(0) == 1000


def test_more_gaussians_asked_for_never_cut_those_at_the_start() -> None:
    sparse = changed(views=3, width=60, height=40)
    assert planned(sparse, max_gaussians=50_000).max_gaussians == sparse.points
    assert planned(sparse, max_gaussians=5000).max_gaussians == 5000


def test_gaussians_are_added_only_where_more_are_allowed() -> None:
    assert planned().densify
    full = planned(changed(points=900_000))
    assert not full.densify
    assert "900000" in full.left_out["densify"]
