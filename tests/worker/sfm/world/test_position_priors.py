"""Proves that positions by GPS hold the shape of a wide, flat scene in its last adjustment, also with errors that
neighbours share, that wrong ones take no part, and that the model keeps its world.

Proven on a generated flight over low hills, with observations of a third of a pixel. Does not prove how much errors of
real receivers are alike: `decisions.md` says what was tried (position-priors).
"""

from __future__ import annotations

import copy
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from splatmill_worker.colmap import pycolmap
from splatmill_worker.images.exif import Exif
from splatmill_worker.sfm import final_model
from splatmill_worker.sfm.cameras import CameraGroup
from splatmill_worker.sfm.mapping import adjust
from splatmill_worker.sfm.mapping.adjust import adjust_with_lenses
from splatmill_worker.sfm.options import SfmOptions
from splatmill_worker.sfm.world import geodesy
from splatmill_worker.sfm.world.georeference import umeyama
from splatmill_worker.sfm.world.position_priors import position_priors
from tests.support.scenes.motions import FOCAL, HEIGHT, WIDTH

Float = np.ndarray[tuple[int, ...], np.dtype[np.float64]]

LUND = np.array([55.7045, 13.1935, 90.0])
ROWS, STEP, ALTITUDE = 12, 200.0, 400.0
"""Strips of a flight and photos of each, metres between two photos, and metres over the ground."""

UNIT = 250.0
"""Metres of a unit of the models' world, which lies on its side."""

TURN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def flight(curvature: float) -> tuple[pycolmap.Reconstruction, Float]:
    """A model that a bulge has got into, as a mapper leaves it, and the true places of its photos in metres."""
    rng = np.random.default_rng(0)
    side = ROWS * STEP
    points = rng.uniform(-0.2 * side, 1.2 * side, (6000, 3))
    points[:, 2] = 20.0 * np.sin(points[:, 0] / 300.0) + rng.uniform(0.0, 15.0, len(points))
    centers = np.array([[STEP * a, STEP * b, ALTITUDE] for a in range(ROWS) for b in range(ROWS)])
    centers += rng.normal(0.0, 5.0, centers.shape)

    def bulged(places: Float) -> Float:
        above = curvature * ((places[:, :2] - side / 2) ** 2).sum(axis=1)
        there: Float = (places + above[:, None] * [0.0, 0.0, 1.0]) @ TURN.T / UNIT
        return there

    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL",
        width=WIDTH,
        height=HEIGHT,
        params=[FOCAL, WIDTH / 2, HEIGHT / 2, 0.0],
        camera_id=1,
    )
    model.add_camera_with_trivial_rig(camera)
    tracks: dict[int, list[tuple[int, int]]] = {}
    for number, center in enumerate(centers):
        tilt = pycolmap.Rotation3d(np.array([*rng.normal(0.0, 0.03, 3), 1.0])).matrix()
        rotation = tilt @ np.diag([1.0, -1.0, -1.0])
        local = (points - center) @ rotation.T
        pixels = FOCAL * local[:, :2] / local[:, 2:] + [WIDTH / 2, HEIGHT / 2]
        pixels += rng.normal(0.0, 0.33, pixels.shape)
        visible = np.flatnonzero(((pixels > 0) & (pixels < [WIDTH, HEIGHT])).all(axis=1))
        keep = rng.permutation(visible)[:60]
        image = pycolmap.Image(
            name=f"{number:06d}.png", keypoints=pixels[keep], camera_id=1, image_id=number + 1
        )
        turned = rotation @ TURN.T
        model.add_image_with_trivial_frame(
            image,
            pycolmap.Rigid3d(np.concatenate([turned, -(turned @ bulged(center[None])[0])[:, None]], axis=1)),
        )
        for place, point in enumerate(keep):
            tracks.setdefault(int(point), []).append((number + 1, place))
    for point, elements in tracks.items():
        if len(elements) >= 3:
            track = pycolmap.Track([pycolmap.TrackElement(*element) for element in elements])
            model.add_point3D(bulged(points[[point]])[0], track, np.zeros(3, np.uint8))
    model.update_point_3d_errors()
    return model, centers


def centers_of(model: pycolmap.Reconstruction) -> Float:
    return np.array([model.images[image].projection_center() for image in sorted(model.reg_image_ids())])


def error(model: pycolmap.Reconstruction, truth: Float) -> float:
    """Root mean square of the distances from the true places after the best similarity, in metres."""
    similarity = umeyama(centers_of(model), truth)
    assert similarity is not None
    rotation, scale, translation = similarity
    return float(
        np.sqrt((((scale * centers_of(model) @ rotation.T + translation) - truth) ** 2).sum(axis=1).mean())
    )


def adjusted(
    model: pycolmap.Reconstruction,
    metres: Float,
    heights: Float | None = None,
    *,
    fixed: bool = False,
    scales: list[Float] | None = None,
) -> tuple[pycolmap.Reconstruction, list[str]]:
    """The final model of photos whose EXIF has these places, and the notes.

    heights: altitudes that it has in place of the true ones; NaN: none.
    scales: of the features of each photo; where they are left out, all have the same.
    """
    places = np.array([geodesy.place(place, LUND) for place in metres])
    if heights is not None:
        places[:, 2] = heights
    photos = [
        SimpleNamespace(exif=Exif(latitude=a, longitude=b, altitude=None if np.isnan(c) else c))
        for a, b, c in places
    ]
    group = CameraGroup(tuple(range(len(photos))), WIDTH, HEIGHT, FOCAL / WIDTH, known=True)
    reports: list[str] = []
    run: Any = SimpleNamespace(
        prepared=SimpleNamespace(photos=photos), groups=[group], options=SfmOptions(), threads=1, notes=[],
        count=len(photos), cancelled=lambda: False, on_mapping=lambda done, total, note: reports.append(note),
    )  # fmt: skip
    scales = scales or [np.ones(len(model.images[number + 1].points2D)) for number in range(len(photos))]
    result: Any = SimpleNamespace(features=[SimpleNamespace(scales=each) for each in scales])
    model, warnings = final_model._polished(run, result, copy.deepcopy(model), fixed)
    assert reports
    assert not warnings
    return model, run.notes


@pytest.fixture(scope="module")
def flown() -> tuple[pycolmap.Reconstruction, Float, float]:
    """The model, the true places, and the error of the model when it is adjusted without GPS."""
    model, truth = flight(2e-6)
    plain = adjust_with_lenses(model, {1: FOCAL}, 1, lambda: False).model
    assert plain.compute_mean_reprojection_error() < 0.5
    return model, truth, error(plain, truth)


Flown = tuple[pycolmap.Reconstruction, Float, float]
GPS = {
    "each its own error": np.random.default_rng(1).normal(0.0, 2.0, (ROWS * ROWS, 3)),
    "one error for a strip": np.repeat(np.random.default_rng(1).normal(0.0, 2.0, (ROWS, 3)), ROWS, axis=0),
}
MEASURED = GPS["each its own error"]


@pytest.mark.parametrize("noise", GPS)
def test_a_bulge_goes(flown: Flown, noise: str) -> None:
    model, truth, without = flown
    result, notes = adjusted(model, truth + GPS[noise])
    assert without > 3.0
    assert error(result, truth) < 0.5 * without
    assert result.compute_mean_reprojection_error() < 0.5
    # It is where it was, in its own unit, and not where GPS has it.
    assert np.abs(centers_of(result) - centers_of(model)).max() < 10.0 / UNIT
    assert [note for note in notes if note.startswith("GPS took part") and "144 positions" in note]


def test_a_bulge_goes_where_large_features_are_wrong_and_photos_are_not_registered(flown: Flown) -> None:
    """The points of all features follow the cameras, and those of photos that are left out are as they were."""
    model, truth, without = flown
    worse = copy.deepcopy(model)
    rng = np.random.default_rng(4)
    scales = []
    for image in range(1, len(truth) + 1):
        observed = worse.images[image].points2D
        large = np.array([point.has_point3D() and point.point3D_id % 3 == 0 for point in observed])
        for index in np.flatnonzero(large):
            observed[int(index)].xy = observed[int(index)].xy + rng.normal(0.0, 3.0, 2)
        scales.append(np.where(large, 9.0, 1.0))
    for number in range(2, len(truth), 13):
        worse.deregister_frame(worse.images[number + 1].frame_id)
    observations = worse.compute_num_observations()
    result, notes = adjusted(worse, truth + MEASURED, scales=scales)
    registered = [image - 1 for image in sorted(result.reg_image_ids())]
    assert len(registered) == len(truth) - 11
    assert error(result, truth[registered]) < 0.6 * without
    assert result.compute_num_observations() == observations
    assert [note for note in notes if "133 positions" in note]


def test_a_position_counts_for_less_the_better_photos_agree(flown: Flown) -> None:
    model, truth, _ = flown
    places = {number + 1: geodesy.place(place, LUND) for number, place in enumerate(truth + MEASURED)}
    worse = copy.deepcopy(model)
    for point in worse.points3D.values():
        point.error *= 2.0
    counted = [position_priors(each, places) for each in (model, worse)]
    assert counted[0] is not None
    assert counted[1] is not None
    variances = [each.priors[0].position_covariance[0, 0] for each in counted if each is not None]
    assert variances[0] == pytest.approx(4.0 * variances[1])
    assert variances[1] > counted[1].error ** 2


def test_a_bulge_larger_than_the_error_of_gps_goes_too(flown: Flown) -> None:
    """It makes GPS seem to be off by more, so that it counts for too little at first."""
    model, truth = flight(2e-5)
    result, _ = adjusted(model, truth + MEASURED)
    assert error(model, truth) > 10.0
    assert error(result, truth) < 0.5 * flown[2]


def test_the_same_photos_give_the_same_cameras(flown: Flown) -> None:
    model, truth, _ = flown
    first, second = (adjusted(model, truth + MEASURED)[0] for _ in range(2))
    np.testing.assert_allclose(centers_of(first), centers_of(second), atol=1e-9)


def test_many_calls_of_the_solver_end_where_one_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """To a centimetre; with a trust region that begins anew with each call, to four."""
    model, truth = flight(2e-5)
    whole, _ = adjusted(model, truth + MEASURED)
    monkeypatch.setattr(adjust, "ITERATED_OBSERVATIONS", 1)
    parts, _ = adjusted(model, truth + MEASURED)
    assert np.abs(centers_of(whole) - centers_of(parts)).max() * UNIT < 0.01


def test_photos_without_a_pose_or_an_altitude_and_with_a_wrong_position_take_no_part(flown: Flown) -> None:
    model, truth, without = flown
    measured, heights = truth + MEASURED, LUND[2] + truth[:, 2] + MEASURED[:, 2]
    measured[::13] += [300.0, -200.0, 80.0]
    heights[1::13] = np.nan
    some = copy.deepcopy(model)
    for number in range(2, len(truth), 13):
        some.deregister_frame(some.images[number + 1].frame_id)
    result, notes = adjusted(some, measured, heights)
    registered = [image - 1 for image in sorted(result.reg_image_ids())]
    assert len(registered) == len(truth) - 11
    assert [note for note in notes if "110 positions" in note]
    assert error(result, truth[registered]) < 0.5 * without


NO_GPS = {
    "anywhere": lambda truth: (np.random.default_rng(2).uniform(0.0, 2000.0, truth.shape), None),
    "without altitudes": lambda truth: (truth, np.full(len(truth), np.nan)),
    "with one altitude": lambda truth: (truth, np.zeros(len(truth))),
    "of a few": lambda truth: (truth, np.where(np.arange(len(truth)) < 50, LUND[2] + truth[:, 2], np.nan)),
}


@pytest.mark.parametrize("case", NO_GPS)
def test_positions_that_say_too_little_take_no_part(flown: Flown, case: str) -> None:
    model, truth, without = flown
    result, notes = adjusted(model, *NO_GPS[case](truth))
    assert error(result, truth) == pytest.approx(without, rel=1e-3)
    assert not notes


def test_positions_along_a_line_take_no_part(flown: Flown) -> None:
    model, truth, _ = flown
    line = copy.deepcopy(model)
    for number in range(ROWS, len(truth)):
        line.deregister_frame(line.images[number + 1].frame_id)
    places = {number + 1: geodesy.place(place, LUND) for number, place in enumerate(truth + MEASURED)}
    assert position_priors(line, places) is None
    assert position_priors(model, places) is not None


def test_a_model_that_has_lost_all_photos_has_none(flown: Flown) -> None:
    model = copy.deepcopy(flown[0])
    for image in list(model.reg_image_ids()):
        model.deregister_frame(model.images[image].frame_id)
    assert position_priors(model, {}) is None


def test_intrinsics_that_are_fixed_stay(flown: Flown) -> None:
    model, truth, _ = flown
    result, _ = adjusted(model, truth + MEASURED, fixed=True)
    np.testing.assert_array_equal(result.cameras[1].params, model.cameras[1].params)
    assert error(result, truth) < 3.0
