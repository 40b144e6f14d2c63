"""Finds the round picture that a circular fisheye lens leaves in a dark frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

DARK = 24.0
"""Grey level up to which a pixel is dark: lenses throw some light onto the frame."""

CORNER = 0.02
"""Side of the corners of a photo that must be dark, as a share of its sides."""

MIN_RADIUS = 0.3
"""Least radius of a circle, as a share of the shorter side."""

EDGE = 0.02
"""Share of the radius by which the border of the picture may lie beside the circle, and which is hidden within it."""

ON_EDGE = 0.9
"""Share of the border that must lie so near. A scene that is dark beside the frame has its border elsewhere."""

RIM = 0.1
"""Width of the rim, as a share of the radius, half of which must be twice as bright as what is dark: an ordinary lens
darkens the corners as well, but over a wide way."""

MIN_BRIGHT = 0.9
"""Share of the circle that must not be dark in all photos."""

Grey = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Circle:
    """A circle on a photo.

    x, y: its middle, as shares of the photo's width and height.
    radius: as a share of the longer side.
    """

    x: float
    y: float
    radius: float

    def outside(self, width: int, height: int) -> npt.NDArray[np.bool_]:
        """Which pixels [height,width] of the photo at this size lie outside, or on the border."""
        rows, columns = np.mgrid[:height, :width] + 0.5
        distance = np.hypot(columns - self.x * width, rows - self.y * height)
        outside: npt.NDArray[np.bool_] = distance > (1.0 - EDGE) * self.radius * max(width, height)
        return outside


def has_dark_corners(grey: Grey) -> bool:
    """Whether the four corners of a picture [h,w] are dark, without which it has no circle."""
    height, width = (max(1, round(CORNER * side)) for side in grey.shape)
    return (
        max(
            float(each[:, :width].max())
            for turned in (grey, grey[:, ::-1])
            for each in (turned[:height], turned[-height:])
        )
        <= DARK
    )


def circle_in(brightest: Grey) -> Circle | None:
    """The circle round what is not dark in the brightest level [h,w] of each pixel in all photos of one camera; None
    where that is not round."""
    height, width = brightest.shape
    bright = brightest > DARK
    if not has_dark_corners(brightest) or not bright.any():
        return None
    border = _border(bright)
    if len(border) < 8:
        return None
    near = np.ones(len(border), bool)
    for _ in range(5):
        # x^2 + y^2 = 2 a x + 2 b y + c is linear in the middle (a, b) and in c, which gives the radius.
        rows = np.concatenate([2.0 * border[near], np.ones((int(near.sum()), 1))], axis=1)
        (a, b, c), *_ = np.linalg.lstsq(rows, np.square(border[near]).sum(axis=1), rcond=None)
        radius = float(np.sqrt(max(c + a * a + b * b, 0.0)))
        off = np.abs(np.hypot(*(border - (a, b)).T) - radius)
        near = off <= np.maximum(EDGE * radius, np.quantile(off, 0.5))
        if near.sum() < 8:
            return None
    if radius < MIN_RADIUS * min(height, width) or np.mean(off <= EDGE * radius + 0.5) < ON_EDGE:
        return None
    circle = Circle(float(a) / width, float(b) / height, radius / max(width, height))
    inside = ~circle.outside(width, height)
    rim = inside & replace(circle, radius=(1.0 - RIM) * circle.radius).outside(width, height)
    ends_at_once = np.median(brightest[rim]) >= 2.0 * DARK
    return circle if ends_at_once and bright[inside].mean() >= MIN_BRIGHT else None


def _border(bright: npt.NDArray[np.bool_]) -> npt.NDArray[np.float64]:
    """Where the first and the last bright pixel of each row and column begins and ends, within the picture [n,2]."""
    points = []
    for across, pixels in ((0, bright), (1, bright.T)):
        lines = np.flatnonzero(pixels.any(axis=1))
        size = pixels.shape[1]
        first, last = pixels[lines].argmax(axis=1), size - pixels[lines, ::-1].argmax(axis=1)
        for place, kept in ((first, first > 0), (last, last < size)):
            ends = np.stack([place[kept].astype(np.float64), lines[kept] + 0.5], axis=1)
            points.append(ends if across == 0 else ends[:, ::-1])
    return np.concatenate(points)
