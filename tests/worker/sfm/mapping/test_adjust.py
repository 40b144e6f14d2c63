"""Proves that the last bundle adjustment estimates only the lens parameters that the motion of the camera determines.

The models are generated: points, cameras, and observations with an error of a third of a pixel, started from a wrong
focal length. Does not prove that photos of such motions can be matched.
"""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from splatmill_worker.colmap import pycolmap
from splatmill_worker.errors import Cancelled
from splatmill_worker.images.lens import PANORAMA
from splatmill_worker.sfm.mapping import adjust
from splatmill_worker.sfm.mapping.adjust import adjust_with_lenses
from tests.support.scenes.motions import FOCAL, Motion, ball, circle, grid, line, model_of

LENS = (-0.2, 0.2, 0.004, -0.003)
"""k1, k2, p1 and p2 of a lens that SIMPLE_RADIAL does not describe."""


@pytest.mark.parametrize(
    ("motion", "tied", "assumed"),
    [(ball, False, False), (circle(0.0), True, False), (line, True, True), (grid, True, True)],
    ids=["ball", "level circle", "line", "grid"],
)
def test_only_determined_parameters_are_estimated(motion: Motion, tied: bool, assumed: bool) -> None:
    start = 1.15 * FOCAL
    adjusted = adjust_with_lenses(model_of(motion, start, distortion=LENS), {1: start}, 1, lambda: False)
    camera = adjusted.model.cameras[1]
    assert (bool(adjusted.tied), bool(adjusted.assumed)) == (tied, assumed)
    assert camera.model.name == ("SIMPLE_RADIAL" if tied else "OPENCV")
    expected = start if assumed else FOCAL
    assert camera.focal_length_x == pytest.approx(expected, rel=1e-9 if assumed else 5e-3)
    assert camera.focal_length_y / camera.focal_length_x == pytest.approx(1, abs=2e-3)
    assert adjusted.model.compute_mean_reprojection_error() < 0.5


def test_a_lens_without_distortion_gets_no_parameters_that_would_explain_noise() -> None:
    adjusted = adjust_with_lenses(model_of(ball, FOCAL), {1: FOCAL}, 1, lambda: False)
    assert adjusted.model.cameras[1].model.name == "SIMPLE_RADIAL"
    assert not adjusted.tied
    assert not adjusted.assumed
    assert abs(adjusted.model.cameras[1].params[3]) < 5e-3


def test_more_parameters_pay_by_the_logarithm_of_the_number_of_residuals() -> None:
    # 2000 residuals, four parameters: 2000 log(cost / less) > 4 log 2000 = 30.4, which is a factor of 1.01532.
    assert adjust.explains_more(101.54, 100.0, 1000, 4)
    assert not adjust.explains_more(101.52, 100.0, 1000, 4)
    assert not adjust.explains_more(101.54, 100.0, 1000, 5)
    assert not adjust.explains_more(100.0, 100.0, 1000, 0)
    assert not adjust.explains_more(0.0, 0.0, 0, 4)


def test_an_initial_focal_length_is_restored_where_views_are_parallel() -> None:
    adjusted = adjust_with_lenses(model_of(grid, 1.3 * FOCAL), {1: FOCAL}, 1, lambda: False)
    assert adjusted.assumed == {1}
    assert adjusted.model.cameras[1].focal_length == pytest.approx(FOCAL)
    assert adjusted.model.compute_mean_reprojection_error() < 0.5


def test_a_camera_of_few_photos_keeps_the_simple_lens_beside_one_of_many() -> None:
    model = model_of(ball, FOCAL, few=4, distortion=LENS)
    initial = dict.fromkeys((1, 2), FOCAL)
    adjusted = adjust_with_lenses(model, initial, 1, lambda: False)
    lenses = {camera: lens.model.name for camera, lens in adjusted.model.cameras.items()}
    assert lenses == {1: "OPENCV", 2: "SIMPLE_RADIAL"}


def test_a_large_model_reports_its_iterations_and_ends_where_a_small_one_does(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    start = 1.15 * FOCAL
    whole = adjust_with_lenses(model_of(ball, start), {1: start}, 1, lambda: False)
    monkeypatch.setattr(adjust, "ITERATED_OBSERVATIONS", 1)
    done: list[int] = []
    parts = adjust_with_lenses(model_of(ball, start), {1: start}, 1, lambda: False, done.append)
    assert done[:2] == [0, adjust.LEAST_ITERATIONS]
    assert len(done) < adjust.MAX_ITERATIONS // adjust.LEAST_ITERATIONS  # it has converged
    error = whole.model.compute_mean_reprojection_error()
    assert parts.model.compute_mean_reprojection_error() == pytest.approx(error, rel=1e-4)
    np.testing.assert_allclose(
        parts.model.cameras[1].params, whole.model.cameras[1].params, rtol=2e-3, atol=2e-3
    )


def test_a_cancelled_adjustment_ends_between_iterations(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adjust, "ITERATED_OBSERVATIONS", 1)
    done: list[int] = []
    with pytest.raises(Cancelled):
        adjust_with_lenses(model_of(ball, 1.15 * FOCAL), {1: FOCAL}, 1, lambda: len(done) == 2, done.append)
    assert done == [0, adjust.LEAST_ITERATIONS]


def test_photos_that_are_not_registered_are_left_out() -> None:
    model = model_of(ball, FOCAL, distortion=LENS)
    model.deregister_frame(model.images[7].frame_id)
    adjusted = adjust_with_lenses(model, {1: FOCAL}, 1, lambda: False)
    assert adjusted.model.num_reg_images() == adjusted.model.num_images() == 35
    assert adjusted.model.cameras[1].model.name == "OPENCV"


def test_a_model_that_has_lost_all_points_is_adjusted_to_nothing() -> None:
    model = model_of(ball, FOCAL)
    for number in list(model.points3D):
        model.delete_point3D(number)
    assert adjust.median_error(model) == np.inf
    adjusted = adjust_with_lenses(model, {1: FOCAL}, 1, lambda: False)
    assert adjusted.assumed == {1}
    assert adjusted.model.cameras[1].focal_length == pytest.approx(FOCAL)


@pytest.mark.parametrize(
    "motion", [ball, circle(0.0), line, grid], ids=["ball", "level circle", "line", "grid"]
)
def test_a_part_of_many_photos_determines_no_more_than_all(
    motion: Motion, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = model_of(motion, FOCAL, few=12)
    adjust.bundle_adjust(model, 1, cancelled=lambda: False)
    whole = adjust.Deviations(model)
    answers = [whole.focal_is_determined(camera) for camera in (1, 2)]
    monkeypatch.setattr(adjust, "PART", 24)
    split = adjust.Deviations(model)
    assert sorted(split._part.model.reg_image_ids()) == list(range(1, 25))
    assert [split.focal_is_determined(camera) for camera in (1, 2)] == answers
    for camera in (1, 2):
        assert whole.focal(camera) <= split._focal(split._part, camera) < math.inf


def test_a_part_that_determines_a_lens_is_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    model = model_of(ball, FOCAL, distortion=LENS)
    monkeypatch.setattr(adjust, "PART", 18)
    estimated: list[int] = []
    estimate = adjust.Estimate.of

    def count(each: pycolmap.Reconstruction) -> adjust.Estimate:
        estimated.append(each.num_reg_images())
        return estimate(each)

    monkeypatch.setattr(adjust.Estimate, "of", count)
    adjusted = adjust_with_lenses(model, {1: FOCAL}, 1, lambda: False)
    assert adjusted.model.cameras[1].model.name == "OPENCV"
    assert estimated == [18]


def test_a_part_has_no_points_of_two_photos_and_an_infinite_covariance_is_none() -> None:
    """Rays that are nearly parallel make the covariance of a whole part infinite, as on a ground of 1,000 photos."""
    model = model_of(ball, FOCAL)
    tracks = {
        number: list(point.track.elements) for number, point in model.points3D.items() if number % 2 == 0
    }
    for elements in tracks.values():
        for element in elements:
            if 2 < element.image_id <= 18:
                model.delete_observation(element.image_id, element.point2D_idx)
    part = adjust.part_of(model, 18)
    assert part.num_reg_images() == 18
    assert min(point.track.length() for point in part.points3D.values()) == 3
    estimate = adjust.Estimate.of(part)
    assert estimate.covariance_of(1) is not None
    assert estimate.covariance_of(9) is None
    infinite: Any = SimpleNamespace(
        get_other_params_cov=lambda params: np.full((len(params), len(params)), np.inf)
    )
    assert adjust.Estimate(part, infinite).covariance_of(1) is None


def test_the_trust_region_goes_on_where_an_earlier_call_has_left_it() -> None:
    first = pycolmap.BundleAdjustmentOptions().ceres.solver_options.initial_trust_region_radius
    assert first == adjust.FIRST_RADIUS
    assert adjust.radius_after(first, 3, 0) == 27 * first
    assert adjust.radius_after(9 * first, 2, 3) == 81 / 8 * first
    assert adjust.radius_after(first, 8, 40) == first
    assert adjust.radius_after(first, 50, 0) == adjust.LARGEST_RADIUS


def test_points_behind_their_cameras_are_left_out_of_the_errors() -> None:
    model = model_of(ball, FOCAL)
    lost, partly = list(model.points3D)[:2]
    photos = {element.image_id for element in model.points3D[partly].track.elements}
    places = {photo: model.images[photo].projection_center() for photo in photos}
    # The cameras look at the origin from a distance of 4: the first point is behind all of them, the second behind one.
    model.points3D[lost].xyz = [0.0, 0.0, 1000.0]
    nearest = min(photos)
    model.points3D[partly].xyz = 1.01 * places[nearest]
    behind = {photo for photo in photos if _depth(model, photo, partly) <= 0}
    assert nearest in behind
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() > 1e100
    before = model.compute_num_observations()
    removed = model.points3D[lost].track.length() + len(behind)
    adjust.update_errors(model)
    assert lost not in model.points3D
    assert model.compute_num_observations() == before - removed
    assert {each.image_id for each in model.points3D[partly].track.elements} == photos - behind
    assert np.isfinite(model.compute_mean_reprojection_error())
    assert model.compute_mean_reprojection_error() < 1e6


def test_a_panorama_keeps_what_is_behind_it() -> None:
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model=PANORAMA, width=800, height=400, params=[800.0, 400.0], camera_id=1)
    )
    points = np.random.default_rng(0).normal(0, 4, (50, 3))
    for number in range(3):
        pose = np.concatenate([np.eye(3), [[-0.5 * number], [0.0], [0.0]]], axis=1)
        local = points @ pose[:, :3].T + pose[:, 3]
        keypoints = [model.cameras[1].img_from_cam(each) for each in local]
        image = pycolmap.Image(name=f"{number}.png", keypoints=keypoints, camera_id=1, image_id=number + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    for number, point in enumerate(points):
        track = pycolmap.Track([pycolmap.TrackElement(image, number) for image in (1, 2, 3)])
        model.add_point3D(point, track, np.zeros(3, np.uint8))
    assert (points[:, 2] < 0).any()
    adjust.update_errors(model)
    assert model.compute_num_observations() == 150
    assert model.compute_mean_reprojection_error() < 1e-4


def _depth(model: pycolmap.Reconstruction, photo: int, point: int) -> float:
    return float((model.images[photo].cam_from_world() * model.points3D[point].xyz)[2])
