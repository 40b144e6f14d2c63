"""Planted light: what a camera's exposure, lens and tone mapping make of the still life, with every number known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float64]

SPARED = 8
"""Every n-th photo, in order of name, keeps its exposure: these are the photos that are held out by default."""

SURROUNDINGS = 0.15
"""Radius of the surroundings of local tone mapping, over the photo's longer side."""


@dataclass(frozen=True)
class Light:
    """How the photos of one camera depart from the scene's own colours.

    exposures: standard deviation, over photos, of the natural logarithm of the exposure (0.3 is 0.43 stops).
    tints: the same of red over green and of blue over green, drawn apart.
    vignetting: share of the light that is missing in the corners; it grows with the square of the distance from the
        centre.
    tone: share of the contrast between a pixel's surroundings and the photo's mean that local tone mapping removes.
    """

    exposures: float = 0.0
    tints: float = 0.0
    vignetting: float = 0.0
    tone: float = 0.0

    def gains(self, photos: int, seed: int = 0) -> Float:
        """Factors [photos, 3] on red, green and blue of each photo; 1 for every photo of number `SPARED` n.

        The logarithms of the others have a mean of zero, so that the spared photos show the mean exposure.
        """
        random = np.random.default_rng(seed)
        log = np.repeat(self.exposures * random.standard_normal(photos)[:, None], 3, axis=1)
        log[:, [0, 2]] += self.tints * random.standard_normal((photos, 2))
        drawn = np.arange(photos) % SPARED > 0
        if drawn.any():
            log -= log[drawn].mean(axis=0)
        return np.exp(np.where(drawn[:, None], log, 0.0))

    def falling_on(self, rgb: npt.NDArray[np.uint8], gain: Float) -> npt.NDArray[np.uint8]:
        """The photo uint8 [H, W, 3] as this camera takes it, with the factors `gain` [3]."""
        values = rgb.astype(np.float64) * gain
        if self.tone:
            values *= np.exp(-self.tone * _local_contrast(values))[..., None]
        if self.vignetting:
            values *= 1.0 - self.vignetting * squared_radius(*rgb.shape[:2])[..., None]
        return (values + 0.5).clip(0, 255).astype(np.uint8)


def squared_radius(height: int, width: int) -> Float:
    """Squared distance [height, width] of pixel centres from the photo's centre, 1 in the corners."""
    rows = (np.arange(height) + 0.5) / height * 2.0 - 1.0
    columns = (np.arange(width) + 0.5) / width * 2.0 - 1.0
    y, x = rows * height, columns * width
    squared: Float = (y[:, None] ** 2 + x[None, :] ** 2) / (height**2 + width**2)
    return squared


def _local_contrast(values: Float) -> Float:
    """Natural logarithm [H, W] of the mean brightness around each pixel, over the mean of the photo."""
    brightness = np.log(np.maximum(values.mean(axis=2), 1.0))
    reach = max(1, round(SURROUNDINGS * max(brightness.shape)))
    for axis in (0, 1):
        brightness = _box_mean(_box_mean(brightness, reach, axis), reach, axis)
    local: Float = brightness - brightness.mean()
    return local


def _box_mean(values: Float, reach: int, axis: int) -> Float:
    """Mean over 2 `reach` + 1 neighbours along `axis`; the border repeats."""
    widths = [(reach + 1, reach) if each == axis else (0, 0) for each in range(2)]
    total = np.cumsum(np.pad(values, widths, mode="edge"), axis=axis)
    size = values.shape[axis]
    upper = np.take(total, np.arange(2 * reach + 1, 2 * reach + 1 + size), axis=axis)
    lower = np.take(total, np.arange(size), axis=axis)
    mean: Float = (upper - lower) / (2 * reach + 1)
    return mean
