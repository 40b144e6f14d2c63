"""The sky: which part of a photo shows it, and a far shell of points that stands for it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatmill_worker.splat.cells import Cells, Flags, Float, Pixels

BLUE, BLUE_BRIGHT = 8.0, 90.0
"""Grey levels by which blue exceeds red, and least brightness: a blue sky far from the sun has more."""

GREY, GREY_BRIGHT = 30.0, 150.0
"""Largest difference between the channels of a cloud, and its least brightness."""

DISTANCE = 5.0
"""Of the shell, over the distance of the farthest tenth of the points: parallax on it is under a cell."""

OPACITY = 0.7
"""Of the shell when training begins: nothing stands behind it."""


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


def shell(cells: Sequence[Cells], points: Float) -> tuple[Float, Pixels]:
    """Points [k, 3] and colours [k, 3] on a sphere around the cameras, where any photo shows sky.

    `points` [n, 3] of the reconstruction set the sphere's radius. There is one for each patch of about a cell's size,
    with the mean of the colours that photos show there.
    """
    centers = np.array([grid.camera.center for grid in cells])
    middle = centers.mean(axis=0)
    spread = float(np.linalg.norm(centers - middle, axis=1).max())
    reach = float(np.percentile(np.linalg.norm(points - middle, axis=1), 90)) if len(points) else 0.0
    radius = DISTANCE * max(reach, spread, 1e-6)
    places, colors = [], []
    for grid in cells:
        rows = np.argwhere(sky_of(grid.color, grid.used) & ~grid.covered)
        away = grid.at(rows, np.ones(len(rows))) - grid.camera.center
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        # Where the ray of a camera that is not in the middle meets the sphere.
        start = grid.camera.center - middle
        along = away @ start
        places.append(start + (np.sqrt(along**2 + radius**2 - start @ start) - along)[:, None] * away)
        colors.append(grid.color[rows[:, 0], rows[:, 1]].astype(np.float64))
    place, color = np.concatenate(places), np.concatenate(colors)
    if not len(place):
        return place, color.astype(np.uint8)
    patch = radius * float(np.median([1.0 / grid.camera.fx for grid in cells]))
    _, group = np.unique(np.floor(place / patch).astype(np.int64), axis=0, return_inverse=True)
    group = group.reshape(-1)
    count = np.bincount(group)[:, None]
    mean = np.stack([np.bincount(group, column) for column in place.T], axis=1) / count
    shade = np.stack([np.bincount(group, column) for column in color.T], axis=1) / count
    return middle + mean, (shade + 0.5).astype(np.uint8)
