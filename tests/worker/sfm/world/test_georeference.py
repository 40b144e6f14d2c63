"""Proves the conversion between places on the earth and metres, and that cameras are located by GPS with noise and
gross errors, or not at all, with the reason, where too little agrees or is covered.

Not proven here: the errors of real receivers, which are alike for photos taken soon after each other.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from splatmill_worker.sfm.world import geodesy, georeference

Float = np.ndarray[tuple[int, ...], np.dtype[np.float64]]
LUND = np.array([55.7045, 13.1935, 40.0])


def test_places_and_metres_are_inverse() -> None:
    offsets = np.random.default_rng(0).uniform(-2000, 2000, (50, 3))
    places = np.array([geodesy.place(offset, LUND) for offset in offsets])
    np.testing.assert_allclose(geodesy.local(places, LUND), offsets, atol=1e-6)


def test_metres_of_a_degree() -> None:
    """Arcs of the ellipsoid at 45 degrees north, from its radii of curvature: 111,131.8 and 78,846.8 m a degree."""
    origin = np.array([45.0, 7.0, 0.0])
    east, north, up = geodesy.local(np.array([[45.001, 7.001, 12.0]]), origin)[0]
    assert (east, north, up) == (
        pytest.approx(78.8468, abs=0.01),
        pytest.approx(111.1318, abs=0.01),
        pytest.approx(12, abs=0.01),
    )


def test_the_equator_and_a_pole_lie_an_axis_from_the_centre() -> None:
    """WGS 84: the semi-axes are 6,378,137 and 6,356,752.3142 m."""
    equator, pole = (
        geodesy.to_earth_centered(np.array(place)) for place in ([0.0, 0.0, 0.0], [90.0, 0.0, 10.0])
    )
    np.testing.assert_allclose(equator @ [1, 2, 3, 1], [6378137 + 3, 1, 2, 1], atol=1e-6)
    np.testing.assert_allclose(pole[:3, 3], [0, 0, 6356752.3142 + 10], atol=1e-4)


def test_the_poles_and_the_date_line_are_places_too() -> None:
    for origin in ([89.99, 179.9999, 0.0], [-45.0, -179.9999, 100.0], [0.0, 180.0, -5.0]):
        base = np.array(origin)
        moved = geodesy.place(np.array([50.0, 60.0, 7.0]), base)
        np.testing.assert_allclose(geodesy.local(moved[None], base)[0], [50, 60, 7], atol=1e-5)


def walk(count: int, size: float, error: float, wrong: int, dimensions: int = 2) -> tuple[Float, Float]:
    """Cameras on a loop of `size` metres across in units of 7 m, and where GPS says that they are."""
    random = np.random.default_rng(count)
    angles = np.linspace(0, 2 * math.pi, count, endpoint=False)
    places = (
        size
        / 2
        * np.stack([np.cos(angles), np.sin(angles), 0.1 * np.cos(3 * angles)], axis=1)[:, :dimensions]
    )
    turn = np.linalg.qr(random.normal(size=(dimensions, dimensions)))[0]
    turn[:, 0] *= np.linalg.det(turn)
    measured = places + random.normal(0, error, places.shape)
    measured[random.choice(count, wrong, replace=False)] += random.uniform(40, 400, (wrong, dimensions))
    return places @ turn / 7.0, measured


@pytest.mark.parametrize("dimensions", [2, 3])
def test_noise_and_gross_errors_of_gps(dimensions: int) -> None:
    centers, measured = walk(40, 80.0, 2.0, 10, dimensions)
    fit = georeference.fit(centers, measured)
    assert not isinstance(fit, str), fit
    assert fit.scale == pytest.approx(7.0, rel=0.03)
    assert 26 <= fit.agreeing.sum() <= 30
    assert 1.0 < fit.error < 3.5
    clean = walk(40, 80.0, 0.0, 0, dimensions)[1]
    moved = fit.scale * centers @ fit.rotation.T + fit.translation
    assert np.linalg.norm(moved - clean, axis=1).max() < 2.5


@pytest.mark.parametrize(
    ("photos", "size", "error", "wrong", "why"),
    [
        (4, 80.0, 0.1, 0, "4 photos have a position by GPS, and 5 are needed"),
        (30, 6.0, 0.3, 0, "the photos were taken within"),
        (30, 8.0, 4.0, 0, "the photos were taken within|positions of only"),
        (30, 80.0, 1.0, 20, "the photos were taken within|positions of only"),
    ],
)
def test_what_gps_does_not_tell(photos: int, size: float, error: float, wrong: int, why: str) -> None:
    outcome = georeference.fit(*walk(photos, size, error, wrong))
    assert isinstance(outcome, str)
    assert any(part in outcome for part in why.split("|")), outcome


def test_photos_at_one_place_tell_nothing() -> None:
    assert (
        georeference.fit(np.zeros((6, 2)), np.ones((6, 2))) == "the photos with GPS were taken at one place"
    )


def test_down_by_gps_needs_two_directions() -> None:
    centers, measured = walk(40, 80.0, 1.0, 0, 3)
    fit = georeference.fit(centers, measured)
    assert not isinstance(fit, str)
    down = georeference.down_by(fit)
    assert down is not None
    assert math.degrees(math.acos(min(1.0, float(-(fit.rotation @ down)[2])))) < 1e-3
    line = np.stack([np.linspace(0, 300, 30), np.zeros(30), np.zeros(30)], axis=1)
    straight = georeference.fit(line, line + np.random.default_rng(0).normal(0, 1, line.shape))
    assert not isinstance(straight, str)
    assert georeference.down_by(straight) is None
