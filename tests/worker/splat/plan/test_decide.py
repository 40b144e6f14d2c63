"""Proves that a plan follows from facts and options alone, survives JSON, explains itself, and that each option forces
the field that it names.

Does not prove that the thresholds are the best ones: `splatmill bench train --configs all` measures what each decision
is worth.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import pytest

from splatmill_worker.splat.plan.decide import DROPOUT
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.plan.rates import Annealing, beta2_of
from splatmill_worker.splat.start.given_model import GivenModel
from tests.support.plans.facts import FACTS, changed, planned

COVERED = {"sightings": 80.0, "sky_share": 0.01, "gap_share": 0.3, "gap_points": 5000, "shell_points": 800}
VARIANTS: list[dict[str, Any]] = [
    {},
    COVERED,
    {**COVERED, "views": 9},
    {"transparent": 43, "distorted": 0, "masked": 3},
    {"transparent": 43, "hull_points": 60_000},
    {"transparent": 43, "points": 0, "hull_points": 60_000},
    {"transparent": 43, "no_hull": "The outlines do not bound an object: 43 %."},
    {
        "points": 3,
        "view_angle": None,
        "light_tail": None,
        "distance_ratio": None,
        "reprojection": None,
    },
    {"light_tail": 0.3, "distance_ratio": 9.0, "reprojection": 2.5, "lens_residual": 4.0},
    {"halving_loss": 0.5, "points": 900_000},
    {"width": 60, "height": 80, "native_longest": 80},
    {"start": GivenModel(700, 3, 27.0, 12.0, 11.0)},
    {"start": GivenModel(700, 3, 27.0, 12.0, 11.0, antialiased=True)},
]
WITHOUT_NUMBER = {
    "No photo is transparent.",
    "No photo has masked pixels.",
    "No photo has lens distortion.",
    "No photo is transparent; a random background keeps training from hiding holes in the surface.",
    "The given model is kept as it is.",
    "The file of the given model says how the model is drawn.",
    "The given model is trained already; reduced photos would blur it.",
    "The distances from which points are seen are not known.",
    "The angles between the views of a point are not known.",
    "The photos' exposures cannot be compared: it is not known which photos show the same points.",
    "Without reprojection errors of points, the cameras are taken to be exact.",
    "There are too few points to tell how far the scene extends.",
    "There are too few points to tell where points are missing.",
}


def test_the_plan_is_pure_and_survives_json() -> None:
    first, second = planned(), planned()
    assert first == second
    assert Plan.from_dict(json.loads(json.dumps(first.as_dict(whole=True)))) == first


@pytest.mark.parametrize("change", VARIANTS)
def test_every_reason_is_a_sentence_with_the_number_that_decided(change: dict[str, Any]) -> None:
    plan = planned(changed(**change))
    for sentence in (*plan.reasons.values(), *plan.left_out.values()):
        assert sentence[0].isupper() or sentence[0].isdigit()
        assert sentence.endswith(".")
        assert sentence in WITHOUT_NUMBER or any(letter.isdigit() for letter in sentence), sentence


@pytest.mark.parametrize("change", VARIANTS)
def test_a_thing_is_either_chosen_or_left_out(change: dict[str, Any]) -> None:
    plan = planned(changed(**change))
    assert not set(plan.reasons) & set(plan.left_out)
    told = plan.as_dict()
    for name in ("far_shell", "gaps", "pose_refinement", "exposure", "antialias", "cluster_culling"):
        assert (name in told) == (name in plan.reasons) == (name not in plan.left_out)
    for name in ("budget", "schedule", "image_size", "max_gaussians", "initial", "background", "sh_degree"):
        assert name in plan.reasons


@pytest.mark.parametrize(
    ("asked", "field", "value"),
    [
        ({"exposure": "on"}, "exposure", True),
        ({"antialias": "on"}, "antialias", True),
        ({"pose_refinement": "on"}, "pose_refinement", True),
        ({"cluster_culling": "on"}, "cluster_culling", True),
        ({"gaps": "off"}, "gaps", False),
        ({"far_shell": "off"}, "far_shell", False),
        ({"densify": "on"}, "densify", True),
        ({"densify": "off"}, "densify", False),
        ({"background": "white"}, "background", "white"),
        ({"max_gaussians": 7000}, "max_gaussians", 7000),
    ],
)
def test_options_force(asked: dict[str, object], field: str, value: object) -> None:
    plan = planned(FACTS, "cpu", **asked)
    assert getattr(plan, field) == value
    assert field in plan.forced
    assert {**plan.reasons, **plan.left_out}[field].startswith("Set by an option.")


def test_the_seed_and_the_degree_are_those_asked_for() -> None:
    plan = planned(seed=5, sh_degree=1)
    assert plan.seed == 5
    assert plan.schedule.degree == 1
    assert "sh_degree" in plan.forced


def test_without_enough_points_gaussians_start_at_random() -> None:
    assert planned(changed(points=20)).initial == "points"
    plan = planned(changed(points=19))
    assert plan.initial == "random"
    assert "19 points" in plan.reasons["initial"]


@pytest.mark.parametrize(("angle", "degree"), [(2.0, 1), (9.0, 2), (40.0, 3), (None, 3)])
def test_the_degree_follows_from_the_angles_between_views(angle: float | None, degree: int) -> None:
    assert planned(changed(view_angle=angle)).schedule.degree == degree


def test_short_runs_take_longer_steps() -> None:
    boosts = [planned(steps=steps).schedule.annealing.boost for steps in (300, 600, 3000, 30_000, 100_000)]
    assert boosts == pytest.approx([8.0, math.sqrt(50), math.sqrt(10), 1.0, 1.0])


def test_squared_gradients_are_averaged_over_a_part_of_the_steps_that_are_expected() -> None:
    assert planned(steps=750).schedule.annealing.beta2 == pytest.approx(0.992)
    assert "averaged over 125 of them" in planned(steps=750).reasons["rates"]
    assert "averaged over 750 of them" in planned(changed(views=11), steps=750).reasons["rates"]
    assert planned(changed(views=11), steps=750).schedule.annealing.beta2 == 0.999
    timed = planned(time_budget=10)
    assert timed.schedule.annealing.beta2 == beta2_of(timed.schedule.expected_steps) < 0.999


def test_a_time_budget_leaves_the_length_of_steps_to_the_run() -> None:
    plan = planned(time_budget=60)
    assert plan.schedule.annealing.boost is None
    assert f"{plan.schedule.expected_steps} steps" in plan.reasons["rates"]


def test_the_rates_of_few_photos_fall_once_each_came_a_hundred_times() -> None:
    for views, budget, hold in (
        (9, {"steps": 3000}, 0.3),
        (9, {"steps": 6000}, 0.25),  # ended after 400 steps on each
        (9, {"steps": 1500}, 0.6),
        (11, {"steps": 2200}, 0.5),
        (12, {"steps": 6000}, 0.6),  # here a photo is set aside, which ends what over-fits
        (9, {"preset": "quality"}, 0.25),
    ):
        plan = planned(changed(views=views), **budget)
        assert plan.schedule.annealing.hold == pytest.approx(hold)
        assert ("fall from the 100th step on each" in plan.reasons["rates"]) == (hold < Annealing.hold)
    timed = planned(changed(views=9), time_budget=60)
    assert timed.schedule.annealing.hold == pytest.approx(900 / timed.schedule.expected_steps)


def test_small_photos_are_not_reduced() -> None:
    assert planned().schedule.resolution == ((0, 4), (200, 2), (500, 1))
    assert planned(changed(width=150, height=200)).schedule.resolution == ((0, 2), (500, 1))
    small = planned(changed(width=60, height=80))
    assert small.schedule.resolution == ((0, 1),)
    assert "80 pixels" in small.left_out["coarse_to_fine"]


def test_the_course_is_counted_in_steps_that_have_a_part_of_the_scene_in_view() -> None:
    """Many captures side by side, trained together for as many times the steps, have the course of one."""
    alone = planned(changed(in_view=0.5), steps=1000).schedule
    assert planned(changed(in_view=0.9), steps=1000).schedule == alone
    assert (alone.resolution, alone.densify_from, alone.densify_every) == (
        ((0, 4), (125, 2), (333, 1)),
        125,
        50,
    )
    together = planned(changed(in_view=0.025, views=800), steps=20_000)
    course = together.schedule
    assert (course.resolution, course.densify_from) == (((0, 4), (2500, 2), (6660, 1)), 2500)
    assert course.densify_every == 1000
    # Positions move by a part of what a photo has in view, not of the whole scene: of a surface 20 times as large, the
    # extent is the root of that.
    assert alone.position_scale == 1.0
    assert course.position_scale == pytest.approx(0.05**0.5)
    assert "2.5 % of the points in view" in together.reasons["densify"]
    whole = course.seen_by(0.05, 1000)
    assert (whole.densify_from, whole.densify_every, whole.in_view) == (125, 50, 1.0)
    half = course.seen_by(0.1, 2000)
    assert (half.densify_from, half.densify_every, half.in_view) == (250, 100, 0.5)
    assert half.position_scale == course.position_scale, "of the same extent"
    assert course.seen_by(1.0, 20_000) == course
    part = alone.seen_by(0.5, 500)
    assert (part.densify_from, part.densify_every, part.in_view) == (62, 40, 1.0)


@pytest.mark.parametrize("share", [1e-3, 0.01, 0.05, 0.2, 0.49, 0.5, 1.0])
@pytest.mark.parametrize("steps", [60, 100, 500, 900, 3000, 30_000])
def test_every_course_comes_to_large_photos_and_adds_gaussians(steps: int, share: float) -> None:
    course = planned(changed(in_view=share), steps=steps).schedule
    assert course.reduced_until <= max(50, steps // 3)
    assert course.densify_from <= max(50, steps // 4)
    assert course.densify_every <= max(40, steps // 8)
    assert sorted(course.resolution) == list(course.resolution)


def test_the_far_shell_keeps_its_opacities() -> None:
    backed = changed(sky_share=0.2, shell_points=700, shell_distance=20.0)
    assert planned(backed).schedule.decay_within == 10.0
    assert planned(backed, far_shell="off").schedule.decay_within is None


def test_opacities_decay_only_where_gaussians_are_added() -> None:
    assert planned().schedule.opacity_decay == 0.9
    assert planned(densify="off").schedule.opacity_decay == 1.0


def test_the_plan_says_how_often_each_photo_comes() -> None:
    course = planned(changed(views=30), steps=3000)
    assert course.schedule.dropout == DROPOUT
    assert "3000 steps show each of 30 photos 100 times" in course.reasons["dropout"]


def test_a_given_model_is_trained_at_full_size_with_the_papers_rates() -> None:
    model = GivenModel(700, 2, psnr=27.0, one_color=12.0, another=11.0)
    plan = planned(changed(start=model, view_angle=2.0), steps=600)
    assert plan.initial == "model"
    assert "initial" in plan.forced
    assert "27.0 dB" in plan.reasons["initial"]
    assert plan.schedule.resolution == ((0, 1),)
    assert plan.schedule.annealing == Annealing(boost=1.0)
    assert not plan.far_shell
    assert not plan.gaps


def test_a_given_model_is_trained_as_its_file_says_it_is_drawn() -> None:
    for said, near_and_far, antialias in ((True, 1.0, True), (False, 9.0, False), (None, 9.0, True)):
        model = GivenModel(700, 2, 27.0, 12.0, 11.0, antialiased=said)
        assert planned(changed(start=model, distance_ratio=near_and_far)).antialias is antialias
    assert not planned(changed(start=replace(model, antialiased=True)), antialias="off").antialias


def test_a_given_model_keeps_its_degree_unless_another_is_asked_for() -> None:
    model = GivenModel(700, 2, psnr=27.0, one_color=12.0, another=11.0)
    narrow = changed(start=model, view_angle=2.0)
    assert planned(narrow).schedule.degree == 2
    assert planned(changed(start=model, view_angle=40.0)).schedule.degree == 3
    assert planned(narrow, sh_degree=0).schedule.degree == 0


def test_a_run_without_budget_stops_when_its_curve_is_flat() -> None:
    assert planned().stops_when_flat
    assert planned().least_gain == 0.2
    assert not planned(time_budget=10, target_psnr=30).stops_when_flat


def test_photos_are_set_aside_where_a_decision_reads_them() -> None:
    assert planned().validation == 3
    assert planned(changed(views=500)).validation == 8
    assert planned(time_budget=10, target_psnr=30).validation == 3


def test_a_budget_of_many_visits_is_watched_for_over_fitting() -> None:
    for plan in (planned(steps=600), planned(steps=4299), planned(time_budget=2)):
        assert plan.validation is None
        assert not plan.stops_when_flat
        assert "over-fitting is watched for from 100 times on" in plan.left_out["validation"]
    long = planned(steps=4300)
    assert (long.validation, long.stops_when_flat, long.least_gain) == (3, True, 0.0)
    assert long.reasons["validation"] == (
        "3 of 43 training photos are set aside until the last decision: about 4300 steps show each of 43 photos 100 "
        "times; where that no longer raises their mean PSNR, the training goes back to its best and ends."
    )
    assert planned(time_budget=600).stops_when_flat


def test_photos_that_a_given_model_may_have_been_trained_on_judge_nothing() -> None:
    model = changed(start=GivenModel(700, 3, 27.0, 12.0, 11.0))
    for plan in (planned(model), planned(model, steps=9000)):
        assert (plan.validation, plan.stops_when_flat, plan.schedule.longest) == (None, False, None)
        assert "may have been trained on any of the 43 photos" in plan.left_out["validation"]
    target = planned(model, target_psnr=30)
    assert (target.validation, target.stops_when_flat, target.schedule.longest) == (3, False, None)


def test_few_photos_are_all_trained_on_unless_a_target_needs_one() -> None:
    for few in (planned(changed(views=11)), planned(changed(views=11), steps=6000)):
        assert few.validation is None
        assert not few.stops_when_flat
        assert few.left_out["validation"].startswith("11 photos are too few to set one aside")
    assert planned(changed(views=11), target_psnr=30).validation == 1
    assert planned(changed(views=2), target_psnr=30).validation == 1
    with pytest.raises(ValueError, match="the only photo is needed for training"):
        planned(changed(views=1), target_psnr=30)


def test_facts_as_plain_values_hold_the_speed_and_the_model() -> None:
    model = GivenModel(700, 2, psnr=27.0, one_color=12.0, another=None)
    told = changed(FACTS, start=model).as_dict()
    assert told["speed"] == {"per_pixel": 2.6e-8, "per_gaussian": 9e-8}
    psnr = {"psnr": 27.0, "one_color": 12.0, "another": None}
    assert told["start"] == {"gaussians": 700, "degree": 2, **psnr, "antialiased": None}


def test_a_hull_adds_gaussians_to_the_points_and_leaves_room() -> None:
    facts = changed(transparent=43, points=3000, hull_points=60_000)
    plan = planned(facts, steps=600)
    assert plan.initial == "hull"
    assert plan.densify
    added = 20_000
    assert f"{added} more start at random within it." in plan.reasons["initial"]
    assert f"Training starts with {3000 + added} Gaussians" in plan.reasons["densify"]


def test_a_plan_without_a_hull_says_why() -> None:
    reason = "The outlines of the photos do not bound an object: 43 % of it."
    for points, initial in ((3000, "points"), (0, "random")):
        plan = planned(changed(transparent=43, points=points, no_hull=reason))
        assert plan.initial == initial
        assert plan.reasons["initial"].endswith(reason)
