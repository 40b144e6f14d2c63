"""Proves that positions by GPS hold the shape of a wide, flat scene in its last adjustment, also with errors that
neighbours share, that wrong ones take no part, and that the model keeps its world.

Proven on a generated flight over low hills, with observations of a third of a pixel. Does not prove how much errors of
real receivers are alike: `decisions.md` says what was tried (position-priors).
"""

from __future__ import annotations

import copy

import numpy as np
import pytest

from splatmill_worker.colmap import pycolmap
from splatmill_worker.sfm.mapping import adjust
from splatmill_worker.sfm.mapping.adjust import Deviations, adjust_with_lenses, bundle_adjust
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


def flight() -> tuple[pycolmap.Reconstruction, Float]:
    """A model that a bulge has got into, as a mapper leaves it, and the true places of its photos in metres."""
    rng = np.random.default_rng(0)
    side = ROWS * STEP
    points = rng.uniform(-0.2 * side, 1.2 * side, (6000, 3))
    points[:, 2] = 20.0 * np.sin(points[:, 0] / 300.0) + rng.uniform(0.0, 15.0, len(points))
    centers = np.array([[STEP * a, STEP * b, ALTITUDE] for a in range(ROWS) for b in range(ROWS)])
    centers += rng.normal(0.0, 5.0, centers.shape)

    def bulged(places: Float) -> Float:
        above = 2e-6 * ((places[:, :2] - side / 2) ** 2).sum(axis=1)
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
        seen = np.flatnonzero(((pixels > 0) & (pixels < [WIDTH, HEIGHT])).all(axis=1))
        keep = rng.permutation(seen)[:60]
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
    return model, centers


def told(metres: Float) -> dict[int, Float]:
    """What the EXIF of the photos says of places in metres, by the ids of their images."""
    return {number + 1: geodesy.place(place, LUND) for number, place in enumerate(metres)}


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


def held(model: pycolmap.Reconstruction, places: dict[int, Float]) -> pycolmap.Reconstruction:
    found = position_priors(model, places)
    assert found is not None
    model = copy.deepcopy(model)
    model.transform(found.to_metres)
    adjusted = adjust_with_lenses(model, {1: FOCAL}, 2, lambda: False, priors=found.priors).model
    adjusted.transform(found.to_metres.inverse())
    return adjusted


@pytest.fixture(scope="module")
def flown() -> tuple[pycolmap.Reconstruction, Float, float]:
    """The model, the true places, and the error of the model when it is adjusted without GPS."""
    model, truth = flight()
    plain = adjust_with_lenses(model, {1: FOCAL}, 2, lambda: False).model
    assert plain.compute_mean_reprojection_error() < 0.5
    return model, truth, error(plain, truth)


Flown = tuple[pycolmap.Reconstruction, Float, float]
GPS = {
    "each its own error": np.random.default_rng(1).normal(0.0, 2.0, (ROWS * ROWS, 3)),
    "one error for a strip": np.repeat(np.random.default_rng(1).normal(0.0, 2.0, (ROWS, 3)), ROWS, axis=0),
}


@pytest.mark.parametrize("noise", GPS)
def test_a_bulge_goes(flown: Flown, noise: str) -> None:
    model, truth, without = flown
    adjusted = held(model, told(truth + GPS[noise]))
    assert without > 3.0
    assert error(adjusted, truth) < 0.5 * without
    assert adjusted.compute_mean_reprojection_error() < 0.5
    # It is where it was, in its own unit, and not where GPS has it.
    assert np.abs(centers_of(adjusted) - centers_of(model)).max() < 10.0 / UNIT


def test_the_same_photos_give_the_same_cameras(flown: Flown) -> None:
    model, truth, _ = flown
    places = told(truth + GPS["each its own error"])
    np.testing.assert_allclose(centers_of(held(model, places)), centers_of(held(model, places)), atol=1e-9)


def test_many_calls_of_the_solver_end_where_one_does(flown: Flown, monkeypatch: pytest.MonkeyPatch) -> None:
    model, truth, without = flown
    monkeypatch.setattr(adjust, "ITERATED_OBSERVATIONS", 1)
    adjusted = held(model, told(truth + GPS["each its own error"]))
    assert error(adjusted, truth) < 0.5 * without


def test_wrong_positions_take_no_part(flown: Flown) -> None:
    model, truth, without = flown
    measured = truth + GPS["each its own error"]
    wrong = np.arange(0, len(truth), 12)
    measured[wrong] += [300.0, -200.0, 80.0]
    found = position_priors(model, told(measured))
    assert found is not None
    assert len(found.priors) == len(truth) - len(wrong)
    assert not {int(prior.corr_data_id.id) for prior in found.priors} & set(wrong + 1)
    assert error(held(model, told(measured)), truth) < 0.5 * without


def test_there_are_none_where_gps_does_not_fit_or_has_no_height(flown: Flown) -> None:
    model, truth, _ = flown
    anywhere = np.random.default_rng(2).uniform(0.0, 2000.0, truth.shape)
    assert position_priors(model, told(anywhere)) is None
    flat = {image: place * [1.0, 1.0, np.nan] for image, place in told(truth).items()}
    assert position_priors(model, flat) is None
    few = {image: place if image <= 4 else place * np.nan for image, place in told(truth).items()}
    assert position_priors(model, few) is None


def test_the_doubt_about_a_lens_is_that_without_gps(flown: Flown) -> None:
    """GPS holds the cameras' places; whether photos determine their lens is judged by the photos."""
    model, truth, _ = flown
    found = position_priors(model, told(truth))
    assert found is not None
    moved = copy.deepcopy(model)
    moved.transform(found.to_metres)
    with_gps = Deviations.of(moved, bundle_adjust(moved, 2, priors=found.priors, cancelled=lambda: False))
    alone = copy.deepcopy(model)
    without_gps = Deviations.of(alone, bundle_adjust(alone, 2, cancelled=lambda: False))
    assert with_gps.focal(moved.cameras[1]) == pytest.approx(without_gps.focal(alone.cameras[1]), rel=0.05)
