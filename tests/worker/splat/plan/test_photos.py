"""Proves the decisions on photos: size, background, exposures, anti-aliasing, and the remarks on lenses and masks.

Does not prove that the thresholds are the best ones.
"""

from __future__ import annotations

import pytest

from splatmill.schema import TrainOptions
from splatmill_worker.splat.plan.photos import loading_size
from tests.support.plans.facts import changed, planned


def test_photos_are_loaded_at_the_presets_size_or_the_one_asked_for() -> None:
    assert loading_size(TrainOptions(), "cpu") == 640
    assert loading_size(TrainOptions(), "gpu") == 1280
    assert loading_size(TrainOptions(image_size=333), "cpu") == 333


def test_photos_that_hold_no_detail_are_halved() -> None:
    plan = planned(changed(halving_loss=0.5))
    assert plan.image_size == 240
    assert "0.5 of 255 grey levels" in plan.reasons["image_size"]
    assert planned(changed(halving_loss=0.5), image_size=480).image_size == 480


def test_the_size_kept_is_explained_by_the_preset_or_the_photos() -> None:
    assert "480 of 960 pixels" in planned().reasons["image_size"]
    assert "full size of 480 pixels" in planned(changed(native_longest=480)).reasons["image_size"]
    small = planned(changed(width=100, height=200, halving_loss=0.5))
    assert small.image_size == 200
    assert "200 pixels are too small" in small.reasons["image_size"]


@pytest.mark.parametrize(
    ("transparent", "views", "background"),
    [(0, 43, "random"), (43, 43, "random"), (0, 9, "black"), (9, 9, "random"), (0, 12, "random")],
)
def test_the_background_is_random_unless_few_photos_are_opaque(
    transparent: int, views: int, background: str
) -> None:
    plan = planned(changed(transparent=transparent, views=views))
    assert plan.background == background
    assert ("alpha" in plan.left_out) == (transparent == 0)


def test_light_is_evened_where_one_photo_in_ten_departs_from_those_around_it() -> None:
    departing = planned(changed(light_tail=0.3))
    assert departing.exposure
    assert "30.0 % or more" in departing.reasons["exposure"]
    # A spread that the photos around predict is left to the colours of the scene.
    assert not planned(changed(exposure_spread=0.4)).exposure
    assert "1.0 %" in planned().left_out["exposure"]
    uncertain = planned(changed(light_tail=0.3, light_error=0.11))
    assert not uncertain.exposure
    assert "error of 11.0 %" in uncertain.left_out["exposure"]
    assert not planned(changed(light_tail=float("nan"))).exposure


def test_light_is_left_where_photos_are_too_far_apart_to_tell_of_one_another() -> None:
    assert planned(changed(light_tail=0.3, light_unseen=0.1)).exposure
    apart = planned(changed(light_tail=0.3, light_unseen=0.2))
    assert not apart.exposure
    assert "too far apart" in apart.left_out["exposure"]
    assert planned(changed(light_tail=0.3, light_unseen=0.2), exposure="on").exposure


def test_light_that_cannot_be_compared_is_not_evened_on_demand() -> None:
    assert "cannot be compared" in planned(changed(light_tail=None)).left_out["exposure"]
    with pytest.raises(ValueError, match="points that several photos show"):
        planned(changed(light_tail=None), exposure="on")
    assert not planned(changed(light_tail=None), exposure="off").exposure


def test_gaussians_are_antialiased_where_distances_differ() -> None:
    assert planned(changed(distance_ratio=9.0)).antialias
    assert not planned(changed(distance_ratio=4.0)).antialias
    assert not planned(changed(distance_ratio=None)).antialias


def test_lenses_and_masks_are_told() -> None:
    assert "50 photos" in planned().reasons["undistortion"]
    assert "3.2 pixels" in planned(changed(lens_residual=3.21)).reasons["undistortion"]
    assert "undistortion" in planned(changed(distorted=0)).left_out
    assert "masks" in planned().left_out
    assert "masks" not in planned(changed(masked=1)).left_out


def test_gaussians_are_added_for_less_long_where_the_light_differs() -> None:
    even, uneven = planned(changed(light_tail=0.0)), planned(changed(light_tail=0.3))
    assert (even.schedule.densify_until, uneven.schedule.densify_until) == (0.7, 0.5)
    assert "growth" not in even.reasons
    assert "differ in their light" in uneven.reasons["growth"]
    # It follows from the photos, not from whether their exposures are corrected.
    assert planned(changed(light_tail=0.3), exposure="off").schedule.densify_until == 0.5
    assert planned(changed(light_tail=0.0), exposure="on").schedule.densify_until == 0.7
