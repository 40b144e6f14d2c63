"""Which part of a photo shows the sky."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatmill_worker.splat.start.cells import Cells, Flags, Pixels

BLUE, BLUE_BRIGHT = 8.0, 90.0
"""Least difference of blue and red, and least brightness, of a blue sky, grey levels of 255."""

GREY, GREY_BRIGHT = 30.0, 150.0
"""Largest difference between channels, and least brightness, of a cloud, grey levels of 255."""

MAX_RED_EXCESS = 4.0
"""Largest excess of red over blue of a cloud, grey levels of 255."""


def sky_of(color: Pixels, used: Flags) -> Flags:
    """bool [h, w]: the cells of a coarse photo uint8 [h, w, 3] that show the sky.

    These are bright blue, white or grey, and so are all cells above them. Cells that are not `used` [h, w] are no sky,
    but sky may continue below them. The photo has to be upright, as its EXIF orientation makes it; in one that is not,
    less sky is found.
    """
    channels = color.astype(np.float64)
    red, green, blue = (channels[..., i] for i in range(3))
    mean = channels.mean(axis=2)
    clear = (blue >= red + BLUE) & (blue >= green) & (mean >= BLUE_BRIGHT)
    cloud = (
        (channels.max(axis=2) - channels.min(axis=2) <= GREY)
        & (mean >= GREY_BRIGHT)
        & (blue >= red - MAX_RED_EXCESS)
    )
    upper: Flags = np.logical_and.accumulate(clear | cloud | ~used, axis=0) & used
    return upper


def sky_share(cells: Sequence[Cells]) -> float:
    """Share of the photos' area that looks like sky and shows no point of the reconstruction, 0 to 1."""
    sky = sum(int((sky_of(grid.color, grid.used) & ~grid.covered).sum()) for grid in cells)
    return sky / max(1, sum(grid.used.size for grid in cells))
