"""Proves that the round picture of a circular fisheye is found to a pixel, cut by the frame or not, and that nothing
else is taken for one."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from splatmill_worker.images.image_circle import Circle, circle_in

Grey = npt.NDArray[np.float32]


def disc(width: int, height: int, x: float, y: float, radius: float) -> Grey:
    """Noise of a scene in a circle, and of a sensor around it."""
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[:height, :width] + 0.5
    inside = np.hypot(columns - x, rows - y) < radius
    levels = np.where(inside, rng.uniform(60, 250, inside.shape), rng.uniform(0, 12, inside.shape))
    return np.asarray(levels, np.float32)


@pytest.mark.parametrize(
    ("width", "height", "x", "y", "radius"),
    [
        (320, 320, 160, 160, 158),  # fills a square photo
        (320, 213, 160, 106, 104),  # fills the height of a 3:2 photo
        (320, 240, 165, 117, 140),  # beside the middle, and cut at top and bottom
        (320, 240, 160, 120, 190),  # larger than the photo is wide: only the corners are dark
        (320, 160, 100, 82, 70),
    ],
)
def test_a_circle_is_found_where_it_is(width: int, height: int, x: float, y: float, radius: float) -> None:
    circle = circle_in(disc(width, height, x, y, radius))
    assert circle is not None
    assert circle.x * width == pytest.approx(x, abs=0.5)
    assert circle.y * height == pytest.approx(y, abs=0.5)
    assert circle.radius * max(width, height) == pytest.approx(radius, abs=1.0)


def test_what_a_lamp_throws_onto_the_frame_and_dark_parts_at_the_rim_do_not_move_it() -> None:
    grey = disc(320, 320, 160, 160, 150)
    grey[:40, 150:170] = 90
    grey[200:215, 280:312] = 5
    circle = circle_in(grey)
    assert circle is not None
    assert circle.radius * 320 == pytest.approx(150, abs=1.5)


def vignette() -> Grey:
    rows, columns = np.mgrid[:240, :320]
    falls = np.cos(np.hypot(columns - 160, rows - 120) / 160) ** 4
    return np.asarray((200 * falls).clip(0), np.float32)


def bars() -> Grey:
    grey = np.random.default_rng(0).uniform(60, 250, (240, 320)).astype(np.float32)
    grey[:40] = grey[-40:] = 3
    return grey


def box() -> Grey:
    grey = np.full((240, 320), 3, np.float32)
    grey[40:200, 60:260] = 150
    return grey


def two_circles() -> Grey:
    return np.concatenate([disc(160, 160, 80, 80, 78), disc(160, 160, 80, 80, 78)], axis=1)


def thing() -> Grey:
    """A thing before black, whose outline is hardly round."""
    rows, columns = np.mgrid[:240, :320]
    angle = np.arctan2(rows - 120, columns - 160)
    inside = np.hypot(columns - 160, rows - 120) < 90 * (1 + 0.1 * np.cos(5 * angle))
    return np.where(inside, 140, 3).astype(np.float32)


@pytest.mark.parametrize(
    "grey",
    [
        vignette(),
        bars(),
        box(),
        two_circles(),
        thing(),
        np.zeros((240, 320), np.float32),
        np.full((240, 320), 90, np.float32),
        np.zeros((1, 1), np.float32),
        disc(320, 320, 160, 160, 20),
    ],
    ids=["vignette", "bars", "box", "two circles", "thing", "black", "grey", "a pixel", "a spot"],
)
def test_nothing_else_is_a_circle(grey: Grey) -> None:
    assert circle_in(grey) is None


def test_what_lies_outside_is_hidden_with_the_border() -> None:
    outside = Circle(0.5, 0.5, 0.5).outside(200, 200)
    assert not outside[100, 10]
    assert outside[100, 1]
    assert outside[0, 0]
    assert 1.0 - outside.mean() == pytest.approx(np.pi / 4 * 0.98**2, abs=0.002)
