"""Proves that observations of large features are left out exactly where the rest determine cameras better, and that
all points follow the cameras.

The models are generated, with observations whose errors are as the test says. Does not prove how the errors of SIFT
features grow with their scales: `worker/bench/decisions.md` has that, by "KEPT_OBSERVATIONS".
"""

import copy
import itertools
import math

import numpy as np
import numpy.typing as npt

from splatmill_worker.colmap import pycolmap
from splatmill_worker.images.lens import PANORAMA
from splatmill_worker.sfm.checks import observations
from splatmill_worker.sfm.mapping import adjust
from splatmill_worker.sfm.mapping.precise import KEPT_OBSERVATIONS, take_cameras, without_large_features
from tests.support.scenes.motions import FOCAL, HEIGHT, POINTS, WIDTH, ball, model_of

Scales = dict[int, npt.NDArray[np.float32]]

SMALL, LARGE = 1.0, 8.0
"""Scales of features, in pixels."""


def with_points(model: pycolmap.Reconstruction, image: int) -> list[int]:
    return [number for number, point in enumerate(model.images[image].points2D) if point.has_point3D()]


def features_of(model: pycolmap.Reconstruction, share: float) -> Scales:
    """Scales of the features of all photos; `share` of the points have large ones."""
    large = {point for point in model.points3D if point <= share * POINTS}
    return {
        image: np.array(
            [LARGE if point.point3D_id in large else SMALL for point in model.images[image].points2D],
            np.float32,
        )
        for image in model.reg_image_ids()
    }


def bend(model: pycolmap.Reconstruction, scales: Scales) -> None:
    """Move the large features, in place, by noise of three pixels and as a lens with a k1 of 0.5 would."""
    rng = np.random.default_rng(1)
    for image, sizes in scales.items():
        for number in np.flatnonzero(sizes == LARGE):
            point = model.images[image].points2D[int(number)]
            offset = (point.xy - np.array([WIDTH / 2, HEIGHT / 2])) / FOCAL
            point.xy = point.xy + 0.5 * FOCAL * offset * (offset @ offset) + rng.normal(0, 3, 2)


def turns(model: pycolmap.Reconstruction, truth: pycolmap.Reconstruction) -> npt.NDArray[np.float64]:
    """Angles in degrees between neighbouring photos of two models, the difference of them."""

    def angles(of: pycolmap.Reconstruction) -> npt.NDArray[np.float64]:
        poses = [of.images[image].cam_from_world().rotation for image in sorted(of.reg_image_ids())]
        return np.degrees([(b * a.inverse()).angle() for a, b in itertools.pairwise(poses)])

    return np.abs(angles(model) - angles(truth))


def test_large_features_that_bend_the_lens_are_left_out_and_their_points_follow_the_cameras() -> None:
    truth = model_of(ball, FOCAL, observed=POINTS)
    model = copy.deepcopy(truth)
    scales = features_of(model, 0.4)
    bend(model, scales)
    observations = model.compute_num_observations()
    small = without_large_features(model, scales)
    assert small is not None
    kept = sum(int((scales[image][with_points(model, image)] == SMALL).sum()) for image in scales)
    assert small.compute_num_observations() == kept < 0.7 * observations
    assert model.compute_num_observations() == observations
    all_of_them = copy.deepcopy(model)
    for each in (small, all_of_them):
        adjust.bundle_adjust(each, 1, cancelled=lambda: False)
    assert all_of_them.cameras[1].params[3] > 0.02
    assert abs(small.cameras[1].params[3]) < 0.002
    assert np.median(turns(small, truth)) < 0.7 * np.median(turns(all_of_them, truth))
    take_cameras(model, small)
    adjust.bundle_adjust(model, 1, fixed_cameras=True, cancelled=lambda: False)
    assert list(model.cameras[1].params) == list(small.cameras[1].params)
    for image in small.reg_image_ids():
        pose = small.images[image].cam_from_world().matrix()
        np.testing.assert_allclose(model.images[image].cam_from_world().matrix(), pose, atol=1e-12)
    assert set(model.points3D) == set(truth.points3D)
    assert model.compute_num_observations() == observations
    errors = [point.error for point in model.points3D.values()]
    assert np.median(errors) < 1.0
    # Each point is where its observations agree best: an adjustment of the points moves none of them any more.
    again = copy.deepcopy(model)
    adjust.bundle_adjust(again, 1, fixed_cameras=True, cancelled=lambda: False)
    for number, point in model.points3D.items():
        np.testing.assert_allclose(again.points3D[number].xyz, point.xyz, atol=1e-3)


def test_points_that_were_not_adjusted_move_with_their_photos() -> None:
    """By a motion of all photos as a whole, points of large features alone stay where these show them."""
    model = model_of(ball, FOCAL, observed=POINTS)
    scales = features_of(model, 0.4)
    bend(model, scales)
    small = without_large_features(model, scales)
    assert small is not None
    left_out = set(model.points3D) - set(small.points3D)
    assert left_out
    turn = pycolmap.Rotation3d(np.array([0.1, -0.2, 0.05, 0.97]) / np.linalg.norm([0.1, -0.2, 0.05, 0.97]))
    motion = pycolmap.Sim3d(1.0, turn, np.array([0.3, -0.1, 0.7]))
    before = {number: model.points3D[number].xyz.copy() for number in left_out}
    small.transform(motion)
    take_cameras(model, small)
    for number in left_out:
        np.testing.assert_allclose(model.points3D[number].xyz, motion * before[number], atol=1e-9)


def test_large_features_as_good_as_small_ones_are_kept() -> None:
    model = model_of(ball, FOCAL, observed=POINTS)
    assert without_large_features(model, features_of(model, 0.4)) is None


def test_a_photo_without_small_features_keeps_the_smallest_ones() -> None:
    model = model_of(ball, FOCAL, observed=POINTS)
    scales = features_of(model, 0.4)
    bend(model, scales)
    blurred = min(scales)
    rng = np.random.default_rng(2)
    scales[blurred] = rng.uniform(LARGE, 2 * LARGE, len(scales[blurred])).astype(np.float32)
    small = without_large_features(model, scales)
    assert small is not None
    before, after = (scales[blurred][with_points(each, blurred)] for each in (model, small))
    smallest = np.sort(before)[:KEPT_OBSERVATIONS]
    assert len(before) > 1.5 * KEPT_OBSERVATIONS
    assert sorted(after) == smallest.tolist()
    # Of points that only large features show, the other photos keep what the blurred one needs.
    large = {point for point in small.points3D if point <= 0.4 * POINTS}
    needed = {small.images[blurred].points2D[number].point3D_id for number in with_points(small, blurred)}
    assert large
    assert large <= needed
    assert all(
        small.points3D[point].track.length() == model.points3D[point].track.length() for point in large
    )


def test_the_limit_makes_the_variance_of_what_is_estimated_smallest() -> None:
    model = model_of(ball, FOCAL, observed=POINTS)
    rng = np.random.default_rng(3)
    scales = {
        image: rng.uniform(1, 9, len(model.images[image].points2D)).astype(np.float32)
        for image in model.reg_image_ids()
    }
    rows = []
    for image, sizes in scales.items():
        ranks = np.argsort(np.argsort(sizes[with_points(model, image)]))
        for number, rank in zip(with_points(model, image), ranks, strict=True):
            point = model.images[image].points2D[number]
            point.xy = point.xy + rng.normal(0, 0.3 * sizes[number], 2)
            shown = model.images[image].project_point(model.points3D[point.point3D_id].xyz)
            assert shown is not None
            loss = 2 * (math.sqrt(1 + ((shown - point.xy) ** 2).sum()) - 1)
            rows.append((rank >= KEPT_OBSERVATIONS, sizes[number], loss))
    large, size, error = (np.array(column) for column in zip(*rows, strict=True))
    limits = np.unique(size)
    chosen = [~large | (size <= limit) for limit in limits]
    best = int(np.argmin([error[each].mean() / each.sum() for each in chosen]))
    small = without_large_features(model, scales)
    assert small is not None
    assert small.compute_num_observations() == chosen[best].sum()
    assert 1.5 < limits[best] < 8.5


def test_what_a_model_hides_behind_a_camera_counts_nothing() -> None:
    model = model_of(ball, FOCAL, observed=POINTS)
    for point in list(model.points3D)[:3]:
        model.points3D[point].xyz = [0.0, 0.0, 1000.0]
    scales = features_of(model, 0.4)
    assert without_large_features(model, scales) is None
    bend(model, scales)
    assert without_large_features(model, scales) is not None


def test_a_panorama_sees_across_its_border() -> None:
    """A point whose feature is at the other border is not off by the width of the panorama."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model=PANORAMA, width=800, height=400, params=[800.0, 400.0], camera_id=1)
    )
    points = np.random.default_rng(0).normal(0, 4, (300, 3))
    points[:5] = [[0.0, 0.1 * k, -4.0] for k in range(5)]  # behind, where the borders meet
    for number in range(3):
        keypoints = np.array([model.cameras[1].img_from_cam(each) for each in points])
        keypoints[:5, 0] = [0.1, 799.9, 0.1, 799.9, 0.1]
        model.add_image_with_trivial_frame(
            pycolmap.Image(name=f"{number}.png", keypoints=keypoints, camera_id=1, image_id=number + 1),
            pycolmap.Rigid3d(),
        )
    for number, point in enumerate(points):
        track = pycolmap.Track([pycolmap.TrackElement(image, number) for image in (1, 2, 3)])
        model.add_point3D(point, track, np.zeros(3, np.uint8))
    errors = [np.linalg.norm(off, axis=1).max() for _, _, off in observations(model)]
    assert max(errors) < 0.2


def test_a_model_without_points_or_photos_has_nothing_to_leave_out() -> None:
    model = model_of(ball, FOCAL)
    for point in list(model.points3D):
        model.delete_point3D(point)
    assert without_large_features(model, features_of(model, 0.4)) is None
    assert without_large_features(pycolmap.Reconstruction(), {}) is None
