"""Proves how many steps and Gaussians a plan allows: by budget, speed, photos, memory and options.

Does not prove that a run keeps to its time; tests/worker/splat/train does.
"""

from __future__ import annotations

from typing import Any

import pytest

from splatmill_worker.splat.plan.budget import Budget
from splatmill_worker.splat.plan.facts import Speed
from splatmill_worker.splat.plan.photos import statistics_memory
from splatmill_worker.splat.plan.plan import Plan
from tests.support.plans.facts import changed, planned


@pytest.mark.parametrize(
    ("preset", "few", "many", "gain"),
    [("draft", 1000, 3060, 0.5), ("balanced", 3000, 9180, 0.2), ("quality", 10_000, 30_600, 0.05)],
)
def test_without_a_budget_the_steps_follow_the_photos_and_end_by_their_gain(
    preset: str, few: int, many: int, gain: float
) -> None:
    for views, steps in ((80, few), (255, many)):
        plan = planned(changed(views=views), preset=preset)
        assert plan.schedule.budget.steps == plan.schedule.expected_steps == steps
        assert plan.reasons["budget"].endswith(
            f"for {views} photos, the preset {preset} allows {steps} steps, and doubles them, up to {4 * steps}, while "
            f"the last doubling gained {gain:g} dB."
        )
        assert plan.schedule.longest == 4 * steps
        assert plan.least_gain == gain
        assert f"by less than {gain:g} dB" in plan.reasons["validation"]


def test_the_longest_time_of_a_preset_is_said_before_it_starts() -> None:
    slow = changed(views=300, speed=Speed(2.6e-7, 9e-8))
    midway = (slow.points * planned(slow).max_gaussians) ** 0.5
    minutes = 36 * 300 * (2.6e-7 * slow.pixels + 9e-8 * midway) / 60
    said = planned(slow).reasons["schedule"]
    assert f"10800 steps take about {int(minutes)}m" in said
    assert f"and 43200 steps {int(4 * minutes)}m" in said


def test_only_a_preset_that_photos_judge_is_doubled() -> None:
    for budget in ({"steps": 3000}, {"time_budget": 60}, {"steps": 700, "target_psnr": 30.0}):
        assert planned(**budget).schedule.longest is None
    few = planned(changed(views=11))
    assert few.schedule.longest is None
    assert (
        few.reasons["budget"] == "No budget was given; for 11 photos, the preset balanced allows 3000 steps."
    )
    assert planned(changed(views=11), target_psnr=30.0).schedule.longest == 40_000


def test_few_photos_from_one_side_end_a_run_whatever_its_budget() -> None:
    few = changed(views=9)
    for budget, seconds in (
        ({"steps": 10_000}, None),
        ({"preset": "quality"}, None),
        ({"time_budget": 300}, 300),
    ):
        course = planned(few, **budget).schedule
        assert (course.budget, course.expected_steps, course.ends_at) == (Budget(3600, seconds), 3600, 3600)
        assert course.annealing.hold == 0.25
        assert "ends after 400 steps on each, 3600" in planned(few, **budget).reasons["schedule"]
    slow = planned(few, time_budget=5)  # fewer steps are expected, and more of them end it all the same
    assert (slow.schedule.budget.steps, slow.schedule.expected_steps < 3600) == (3600, True)
    assert "400 steps on each" not in slow.reasons["schedule"]
    short = planned(few, steps=3600).schedule
    assert (short.budget.steps, short.ends_at) == (3600, None)
    for watched in (
        planned(changed(views=12), steps=10_000),
        planned(few, steps=10_000, target_psnr=30.0),
        planned(changed(views=9, alignment=0.5), steps=10_000),  # all around, where more steps gain
    ):
        assert (watched.schedule.budget.steps, watched.schedule.ends_at) == (10_000, None)


def test_a_target_alone_gets_the_steps_of_the_best_preset() -> None:
    alone = planned(target_psnr=30.0, preset="draft")
    assert (alone.schedule.budget.steps, alone.least_gain) == (10_000, 0.05)
    assert planned(target_psnr=30.0, steps=700).schedule.budget.steps == 700


def test_the_expected_steps_take_the_time_of_the_budget_midway_through_the_growth() -> None:
    for seconds in (5, 60):
        plan = planned(time_budget=seconds)
        step = Speed(2.6e-8, 9e-8).step(270 * 480, (11_450 * plan.max_gaussians) ** 0.5)
        assert step * plan.schedule.expected_steps == pytest.approx(seconds, rel=1e-2)
        assert plan.schedule.budget.seconds == seconds


def test_a_budget_of_few_visits_names_the_time_that_a_draft_takes() -> None:
    few, enough = planned(changed(views=400), time_budget=10), planned(time_budget=60)
    assert f"{few.schedule.expected_steps / 400:.1f} times" in few.reasons["schedule"]
    assert "that would take" in few.reasons["schedule"]
    assert "times" not in enough.reasons["schedule"]


def test_steps_cut_a_time_budget_short() -> None:
    plan = planned(time_budget=60, steps=200)
    assert plan.schedule.expected_steps == 200
    assert (plan.schedule.budget.steps, plan.schedule.budget.seconds) == (200, 60)
    assert "of which the option steps asks for 200" in plan.reasons["schedule"]


def test_fewer_gaussians_than_a_budget_pays_for_leave_time_for_more_steps() -> None:
    few, many = planned(time_budget=60, max_gaussians=12_000), planned(time_budget=60)
    assert few.schedule.expected_steps > many.schedule.expected_steps


def test_the_photos_limit_the_gaussians_whatever_the_budget() -> None:
    for budget in ({"steps": 600}, {"time_budget": 10}, {"preset": "quality", "image_size": 480}):
        plan = planned(**budget)
        assert plan.max_gaussians == round(43 * 270 * 480 / 50)
        assert "43 photos of 129600 pixels" in plan.reasons["max_gaussians"]
    assert planned(changed(views=430), steps=600).max_gaussians == round(430 * 270 * 480 / 50)


def test_memory_bounds_the_gaussians() -> None:
    plan = planned(max_memory=400_000_000, steps=30_000)
    assert (
        plan.max_gaussians
        == Plan.gaussians_within(400_000_000, best=False)
        < planned(steps=30_000).max_gaussians
    )
    assert "Memory" in plan.reasons["max_gaussians"]
    assert Plan.gaussians_within(0) == 1000
    # What recovering the cameras of many photos leaves behind is no room for Gaussians, nor are the statistics of
    # photos where memory holds all of them, but half of it all is. The best snapshot is kept where the photos may end
    # the training.
    cases: tuple[tuple[int, dict[str, Any], float], ...] = (
        (0, {"steps": 30_000}, (3000 - 350) / (59 * 4 * 16)),
        (610, {"steps": 30_000}, (3000 - 700) / (59 * 4 * 16)),
        (610, {"time_budget": 3600}, (3000 - 700) / (59 * 4 * 19)),
        (610, {"steps": 30_000, "target_psnr": 40}, (3000 - 700) / (59 * 4 * 19)),
        (2900, {"steps": 30_000}, 1500 / (59 * 4 * 16)),
    )
    for used, options, left in cases:
        after = planned(changed(memory_used=used * 10**6, views=900), max_memory=3 * 10**9, **options)
        assert after.max_gaussians == int(left * 10**6)
        assert ("MB of the process" in after.reasons["max_gaussians"]) == (0 < used < 1000)


def test_statistics_of_all_photos_are_kept_or_of_none() -> None:
    assert statistics_memory(None, 1e12) == 400 * 10**6
    assert statistics_memory(8 * 10**9, 400e6 / 9.2) == 400 * 10**6
    assert statistics_memory(8 * 10**9, 400e6 / 9.1) == 0
    assert statistics_memory(800 * 10**6, 100e6 / 9.2) == 100 * 10**6
    few = planned(changed(memory_used=10**9, points=300_000), max_memory=2 * 10**9, steps=30_000)
    assert few.max_gaussians == 10**9 // (59 * 4 * 16)
    assert "beside the 1.0 GB of the process and 250.0 MB for statistics" in few.reasons["max_gaussians"]


def test_more_gaussians_asked_for_never_cut_those_at_the_start() -> None:
    sparse = changed(views=3, width=60, height=40)
    assert planned(sparse, max_gaussians=50_000).max_gaussians == sparse.points
    assert planned(sparse, max_gaussians=5000).max_gaussians == 5000


def test_gaussians_are_added_only_where_more_are_allowed() -> None:
    assert planned().densify
    full = planned(changed(points=900_000))
    assert not full.densify
    assert "900000" in full.left_out["densify"]
