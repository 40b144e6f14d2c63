"""Proves that the plan follows from facts and options alone, that it says why, and what schedules and budgets mean.

Does not prove that the thresholds are the best ones: `bench train --configs all` measures what each choice is worth.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest

from splatmill.schema import TrainOptions
from splatmill_worker.splat.plan.budget import Budget
from splatmill_worker.splat.plan.decide import decide
from splatmill_worker.splat.plan.facts import Facts, Speed
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.plan.rates import Annealing, RateSchedule
from splatmill_worker.splat.plan.schedule import Schedule
from splatmill_worker.splat.train.pace import Pace

FACTS = Facts(
    views=43,
    held_out=7,
    width=270,
    height=480,
    native_longest=960,
    points=11_450,
    source="colmap",
    transparent=0,
    masked=0,
    distorted=50,
    halving_loss=4.3,
    exposure_spread=0.02,
    view_angle=30.0,
    distance_ratio=1.9,
    reprojection=0.9,
    memory_available=16 * 10**9,
    speed=Speed(per_pixel=2.6e-8, per_gaussian=9e-8),
)


def options(**values: object) -> TrainOptions:
    return TrainOptions.model_validate(values)


def planned(facts: Facts = FACTS, **values: object) -> Plan:
    return decide(facts, options(**values), "cpu")


def test_the_plan_is_pure_and_survives_json() -> None:
    first, second = planned(), planned()
    assert first == second
    assert Plan.from_dict(json.loads(json.dumps(first.as_dict(whole=True)))) == first


def test_every_field_has_its_reason_and_absent_ones_say_why() -> None:
    plan = planned()
    told = plan.as_dict()
    for name in ("schedule", "image_size", "max_gaussians", "densify", "initial", "background", "sh_degree"):
        assert plan.reasons[name].endswith((".", "it.")), name
    assert "exposure" not in told
    assert "2.0 %" in plan.left_out["exposure"]
    assert {"alpha", "masks", "antialias", "exposure", "pose_refinement"} <= set(plan.left_out)
    assert not set(plan.reasons) & set(plan.left_out)


@pytest.mark.parametrize(
    ("change", "field", "value"),
    [
        ({"exposure_spread": 0.3}, "exposure", True),
        ({"exposure_spread": None}, "exposure", False),
        ({"tint_spread": 0.2}, "exposure", True),
        ({"sky_share": 0.0, "shell_points": 800}, "far_shell", True),
        ({"sky_share": 0.01, "shell_points": 800, "views": 11}, "far_shell", False),
        ({"sky_share": 0.3, "shell_points": 800, "views": 11}, "far_shell", True),
        ({"sky_share": None}, "far_shell", False),
        ({"sky_share": None, "transparent": 43}, "far_shell", False),
        ({"gap_share": 0.3, "gap_points": 5000}, "gaps", True),
        ({"gap_share": 0.02, "gap_points": 50}, "gaps", False),
        ({"reprojection": 2.5}, "pose_refinement", True),
        ({"transparent": 43}, "background", "random"),
        ({"transparent": 0}, "background", "random"),
        ({"transparent": 0, "views": 9}, "background", "black"),
        ({"transparent": 9, "views": 9}, "background", "random"),
        ({"points": 3}, "initial", "random"),
        ({"distance_ratio": 9.0}, "antialias", True),
        ({"halving_loss": 0.5}, "image_size", 240),
        ({"points": 900_000}, "densify", False),
    ],
)
def test_facts_decide(change: dict[str, object], field: str, value: object) -> None:
    plan = planned(replace(FACTS, **change))  # type: ignore[arg-type]
    assert getattr(plan, field) == value


@pytest.mark.parametrize(("angle", "degree"), [(2.0, 1), (9.0, 2), (40.0, 3), (None, 3)])
def test_the_degree_follows_from_the_angles_between_views(angle: float | None, degree: int) -> None:
    assert planned(replace(FACTS, view_angle=angle)).schedule.degree == degree


@pytest.mark.parametrize(
    ("asked", "field", "value"),
    [
        ({"exposure": "on"}, "exposure", True),
        ({"antialias": "on"}, "antialias", True),
        ({"pose_refinement": "on"}, "pose_refinement", True),
        ({"gaps": "off"}, "gaps", False),
        ({"far_shell": "off"}, "far_shell", False),
        ({"densify": "on"}, "densify", True),
        ({"densify": "off"}, "densify", False),
        ({"background": "white"}, "background", "white"),
        ({"max_gaussians": 7000}, "max_gaussians", 7000),
        ({"seed": 5}, "seed", 5),
    ],
)
def test_options_force(asked: dict[str, object], field: str, value: object) -> None:
    plan = planned(**asked)
    assert getattr(plan, field) == value
    if field != "seed":
        assert field in plan.forced


def test_what_is_added_to_start_with_counts_among_the_gaussians() -> None:
    sparse = replace(FACTS, points=900, gap_share=0.5, gap_points=30_000, sightings=90.0)
    plan = planned(sparse, steps=100)
    assert plan.max_gaussians == 30_900
    assert "30000 Gaussians are added there" in plan.reasons["gaps"]
    assert planned(sparse, steps=100, gaps="off").max_gaussians < 30_000
    walled = planned(replace(sparse, sky_share=0.12, shell_points=700), steps=100)
    assert walled.max_gaussians == 31_600
    assert "12 % of the photos look like sky: 700 Gaussians" in walled.reasons["far_shell"]


def test_the_far_shell_keeps_its_opacities() -> None:
    backed = replace(FACTS, sky_share=0.2, shell_points=700, shell_distance=20.0)
    assert planned(backed).schedule.decay_within == 10.0
    assert planned(backed, far_shell="off").schedule.decay_within is None


def test_what_cannot_be_followed_is_refused() -> None:
    with pytest.raises(ValueError, match="gpu kernels"):
        decide(FACTS, options(pose_refinement="on"), "gpu")
    with pytest.raises(ValueError, match="two photos"):
        planned(replace(FACTS, views=1), pose_refinement="on")
    with pytest.raises(ValueError, match="far_shell=on is for opaque photos, and 43"):
        planned(replace(FACTS, transparent=43), far_shell="on")
    with pytest.raises(ValueError, match="far_shell=on needs points"):
        planned(far_shell="on")


def test_more_time_allows_more_steps_and_more_gaussians() -> None:
    plans = [planned(time_budget=seconds) for seconds in (5, 20, 80)]
    counts = [plan.max_gaussians for plan in plans]
    assert counts == sorted(set(counts))
    assert all(
        plan.schedule.budget.seconds == seconds for plan, seconds in zip(plans, (5, 20, 80), strict=True)
    )
    slow = planned(replace(FACTS, speed=Speed(2.6e-6, 9e-6)), time_budget=80)
    assert slow.max_gaussians < plans[-1].max_gaussians


def test_memory_bounds_the_gaussians() -> None:
    plan = planned(max_memory=400_000_000, steps=30_000)
    assert plan.max_gaussians == Plan.gaussians_within(400_000_000) < planned(steps=30_000).max_gaussians
    assert "Memory" in plan.reasons["max_gaussians"]


def test_a_budget_is_spent_by_whichever_ends_first() -> None:
    assert Budget(100).progress(25, 1e9) == 0.25
    assert Budget(None, 10.0).progress(10**6, 4.0) == 0.4
    assert Budget(100, 10.0).progress(50, 9.0) == 0.9
    assert Budget(100).progress(1000, 0.0) == 1.0
    assert Budget(1000).ending_at(0.5, 0.1).progress(550, 0.0) == 1.0
    with pytest.raises(ValueError, match="neither"):
        Budget(None)


def test_the_schedule_goes_from_coarse_to_fine() -> None:
    schedule = Schedule(Budget(1000), ((0, 4), (200, 2), (500, 1)), 3, 300, 100, 0.7, 1000)
    assert [schedule.reduction(step) for step in (1, 200, 201, 500, 501, 1000)] == [4, 4, 2, 2, 1, 1]
    events = [step for step in range(1, 1001) if schedule.densifies(step, step / 1000)]
    assert events == [300, 400, 500, 600]


def test_short_runs_take_longer_steps_and_fewer_gaussians() -> None:
    boosts = [planned(steps=steps).schedule.annealing.boost for steps in (300, 600, 3000, 30_000, 100_000)]
    assert boosts == pytest.approx([8.0, math.sqrt(50), math.sqrt(10), 1.0, 1.0])
    short, long = planned(steps=600), planned(steps=2400)
    assert long.max_gaussians == pytest.approx(2 * short.max_gaussians, rel=1e-3)
    plain, boosted = RateSchedule(2.0).at(0.2), RateSchedule(2.0, Annealing(boost=4.0)).at(0.2)
    assert boosted.means == pytest.approx(4 * plain.means)
    assert boosted.logit_opacities == pytest.approx(2 * plain.logit_opacities)
    assert boosted.sh_rest == pytest.approx(4 * 2 * 1.25e-4)
    assert plain.sh_rest == pytest.approx(1.25e-4 * 2 / 3)


def test_a_time_budget_is_laid_out_for_the_gaussians_it_pays_for() -> None:
    plans = [planned(time_budget=seconds) for seconds in (10, 20, 40)]
    counts = [plan.max_gaussians for plan in plans]
    assert counts == sorted(counts)
    assert counts[0] < counts[-1]


def test_a_time_budget_corrects_how_many_steps_it_holds() -> None:
    plan = planned(time_budget=60)
    assert plan.schedule.annealing.boost is None
    assert f"{plan.schedule.expected_steps} steps" in plan.reasons["rates"]
    assert planned(time_budget=60, steps=200).schedule.expected_steps == 200
    pace, budget = Pace(30_000), Budget(None, 100.0)
    for _ in range(99):
        pace.record(0.1)
    assert pace.steps(budget, 99, 9.9) == 30_000
    pace.record(0.1)
    assert pace.steps(budget, 100, 10.0) == 1000
    for _ in range(2000):
        pace.record(0.2)
    assert pace.steps(budget, 1100, 60.0) == pytest.approx(1300, abs=1)
    assert pace.steps(Budget(1200, 100.0), 1100, 60.0) == 1200
    assert pace.steps(budget, 1100, 100.5) == 1100
    with pytest.raises(ValueError, match="only a run"):
        RateSchedule(2.0, Annealing(boost=None)).at(0.5)


def test_fewer_gaussians_than_a_budget_pays_for_leave_time_for_more_steps() -> None:
    def laid_out(**values: object) -> int:
        return planned(time_budget=60, **values).schedule.expected_steps

    assert laid_out(max_gaussians=12_000) > laid_out()


def test_more_gaussians_asked_for_never_cut_those_at_the_start() -> None:
    sparse = replace(FACTS, views=3, width=60, height=40)
    assert planned(sparse, max_gaussians=50_000).max_gaussians == sparse.points
    assert planned(sparse, max_gaussians=5000).max_gaussians == 5000


def test_gaps_are_left_when_few_photos_could_correct_a_guess() -> None:
    bare = replace(FACTS, gap_share=0.4, gap_points=500, sightings=80.0)
    assert planned(bare).gaps
    few = planned(replace(bare, views=11))
    assert not few.gaps
    assert "11 photos are too few" in few.left_out["gaps"]


def test_rates_fall_to_their_ends() -> None:
    rates = RateSchedule(extent=2.0)
    start, end = rates.at(0.0), rates.at(1.0)
    assert start.means == pytest.approx(3.2e-4)
    assert end.means == pytest.approx(0.01 * start.means)
    assert end.sh_dc == pytest.approx(0.1 * start.sh_dc)
    assert start.sh_rest == pytest.approx(start.sh_dc / 30)
    halved = RateSchedule(extent=2.0, scale=0.5).at(0.3)
    assert halved.log_scales == pytest.approx(0.5 * rates.at(0.3).log_scales)
    assert all(math.isfinite(value) for value in end.rows())
