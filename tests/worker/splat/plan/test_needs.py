"""Proves when far shell, gap filling and pose refinement are part of a plan, and which options are refused.

Does not prove that these parts do what they are for: tests/worker/splat/start and train do.
"""

from __future__ import annotations

from typing import Any

import pytest

from splatmill_worker.splat.start.given_model import GivenModel
from tests.support.plans.facts import changed, planned

MODEL = GivenModel(700, 2, psnr=27.0, one_color=12.0, another=11.0)
BARE: dict[str, Any] = {"gap_share": 0.4, "gap_points": 500, "sightings": 80.0}


@pytest.mark.parametrize(
    ("change", "far_shell"),
    [
        ({"sky_share": 0.0}, True),
        ({"sky_share": 0.01, "views": 11}, False),
        ({"sky_share": 0.3, "views": 11}, True),
        ({"sky_share": 0.01, "views": 11, "alignment": 0.6}, True),
        ({"sky_share": 0.01, "views": 11, "alignment": 0.65}, False),
        ({"sky_share": 0.01, "views": 12, "alignment": 0.65}, True),
        ({"sky_share": None}, False),
        ({"sky_share": None, "transparent": 43}, False),
        ({"sky_share": 0.3, "start": MODEL}, False),
    ],
)
def test_a_far_shell_stands_behind_opaque_scenes(change: dict[str, Any], far_shell: bool) -> None:
    assert planned(changed(shell_points=800, **change)).far_shell == far_shell


def test_gaps_are_filled_where_there_are_many() -> None:
    assert planned(changed(**BARE)).gaps
    assert not planned(changed(gap_share=0.02, gap_points=50)).gaps
    assert not planned(changed(**BARE, start=MODEL)).gaps


def test_gaps_are_left_when_few_photos_could_correct_a_guess() -> None:
    assert planned(changed(**BARE, views=12)).gaps
    few = planned(changed(**BARE, views=11))
    assert not few.gaps
    assert "11 photos are too few" in few.left_out["gaps"]


def test_gaps_are_left_where_photos_of_the_other_side_look_through_them() -> None:
    assert planned(changed(**BARE, alignment=0.65)).gaps
    around = planned(changed(**BARE, alignment=0.6))
    assert not around.gaps
    assert "more than half a turn" in around.left_out["gaps"]
    assert planned(changed(**BARE, alignment=0.6), gaps="on").gaps


def test_gaussians_added_beside_points_count_among_the_first_ones() -> None:
    sparse = changed(width=100, height=100, points=900, gap_share=0.5, gap_points=30_000, sightings=90.0)
    plan = planned(sparse, steps=100)
    assert plan.max_gaussians == 30_900
    assert "30000 Gaussians are added there" in plan.reasons["gaps"]
    assert planned(sparse, steps=100, gaps="off").max_gaussians < 30_000
    walled = planned(changed(sparse, sky_share=0.12, shell_points=700), steps=100)
    assert walled.max_gaussians == 31_600
    assert walled.reasons["far_shell"].startswith("700 Gaussians stand on a far shell behind the scene")
    assert walled.reasons["far_shell"].endswith("12 % of the photos look like sky.")


def test_cameras_are_corrected_where_they_err_by_pixels_of_the_training_size() -> None:
    assert planned(changed(reprojection=2.5)).pose_refinement
    assert not planned(changed(reprojection=0.9)).pose_refinement
    assert not planned(changed(reprojection=None)).pose_refinement
    # Halved photos halve the error.
    assert not planned(changed(reprojection=1.9, halving_loss=0.5)).pose_refinement
    assert planned(changed(reprojection=1.9)).pose_refinement
    assert not planned(changed(reprojection=2.5, views=1)).pose_refinement
    on_gpu = planned(changed(reprojection=2.5), kernels="gpu")
    assert not on_gpu.pose_refinement
    assert "2.50 pixels" in on_gpu.left_out["pose_refinement"]


@pytest.mark.parametrize("name", ["far_shell", "gaps"])
@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"transparent": 43}, "is for opaque photos, and 43 of these are transparent"),
        ({}, "needs points of the reconstruction"),
        ({"start": MODEL}, "this training starts from a model"),
    ],
)
def test_seeds_without_points_to_add_to_are_refused(name: str, change: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says) as refused:
        planned(changed(**change), "cpu", **{name: "on"})
    assert str(refused.value).startswith(f"{name}=on ")
    assert str(refused.value).endswith(f"Set {name} to auto.")


def test_corrections_of_cameras_that_cannot_be_made_are_refused() -> None:
    with pytest.raises(ValueError, match=r"pose_refinement=on needs .* gpu kernels do not compute"):
        planned(kernels="gpu", pose_refinement="on")
    with pytest.raises(ValueError, match="pose_refinement=on needs at least two photos"):
        planned(changed(views=1), pose_refinement="on")
