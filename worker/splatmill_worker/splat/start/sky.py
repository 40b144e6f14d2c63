"""The sky: which part of a photo shows it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatmill_worker.splat.start.cells import Cells, Flags, Pixels

BLUE, BLUE_BRIGHT = 8.0, 90.0
"""Grey levels by which blue exceeds red, and least brightness: a blue sky far from the sun has more."""

GREY, GREY_BRIGHT = 30.0, 150.0
"""Largest difference between the channels of a cloud, and its least brightness."""


def sky_of(color: Pixels, used: Flags) -> Flags:
    """bool [h, w] of a coarse photo uint8 [h, w, 3]: bright blue, white or grey, with nothing else above it.

    Cells that are not `used` [h, w] hide nothing below them, and are no sky. Photos are upright by their EXIF
    orientation; in one that is not, little is found and nothing is lost.
    """
    channels = color.astype(np.float64)
    red, green, blue = (channels[..., i] for i in range(3))
    mean = channels.mean(axis=2)
    clear = (blue >= red + BLUE) & (blue >= green) & (mean >= BLUE_BRIGHT)
    cloud = (
        (channels.max(axis=2) - channels.min(axis=2) <= GREY) & (mean >= GREY_BRIGHT) & (blue >= red - 4.0)
    )
    upper: Flags = np.logical_and.accumulate(clear | cloud | ~used, axis=0) & used
    return upper


def sky_share(cells: Sequence[Cells]) -> float:
    """Share of all photos that shows sky without a point of the reconstruction on it."""
    sky = sum(int((sky_of(grid.color, grid.used) & ~grid.covered).sum()) for grid in cells)
    return sky / max(1, sum(grid.used.size for grid in cells))
