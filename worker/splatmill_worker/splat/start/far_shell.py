"""A far shell of Gaussians behind the scene: what stands for the sky, and for whatever no point describes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatmill_worker.splat.start.cells import Cells, Float, Pixels

DISTANCE = 5.0
"""Of the shell, over the distance of the farthest tenth of the points: parallax on it is under a cell."""

OPACITY = 0.7
"""Of the shell when training begins: nothing stands behind it."""

PATCH = 2.0
"""Cells to a Gaussian's side: 600 steps on fox, lund and the still life end alike with 2 and 4 (two seeds)."""

BEYOND = 6
"""Cells by which a photo's border goes on: held-out photos look a little past the others."""

GUESSED = 0.05
"""Weight of a colour from beyond a border; 1 is that of a colour which a photo shows."""


def shell_points(cells: Sequence[Cells], points: Float) -> tuple[Float, Pixels]:
    """Points [k, 3] and colours uint8 [k, 3] on a sphere around the cameras, wherever photos look.

    `points` [n, 3] of the reconstruction set the sphere's radius. There is one for each patch, with the mean of the
    colours that photos show in its direction, whatever stands in front of it there: the sky where that is seen, and
    elsewhere a colour that passes where the scene has a hole.
    """
    centers = np.array([grid.camera.center for grid in cells])
    middle = centers.mean(axis=0)
    spread = float(np.linalg.norm(centers - middle, axis=1).max())
    reach = float(np.percentile(np.linalg.norm(points - middle, axis=1), 90)) if len(points) else 0.0
    radius = DISTANCE * max(reach, spread, 1e-6)
    places, colors, weights = [], [], []
    for grid in cells:
        height, width = grid.used.shape
        there = np.argwhere(np.ones((height + 2 * BEYOND, width + 2 * BEYOND), bool)) - BEYOND
        inside = there.clip(0, (height - 1, width - 1))
        used = grid.used[inside[:, 0], inside[:, 1]]
        there, inside = there[used], inside[used]
        away = grid.at(there, np.ones(len(there))) - grid.camera.center
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        # Where the ray of a camera that is not in the middle meets the sphere.
        start = grid.camera.center - middle
        along = away @ start
        places.append(start + (np.sqrt(along**2 + radius**2 - start @ start) - along)[:, None] * away)
        colors.append(grid.color[inside[:, 0], inside[:, 1]].astype(np.float64))
        weights.append(np.where((there == inside).all(axis=1), 1.0, GUESSED))
    place, color, weight = np.concatenate(places), np.concatenate(colors), np.concatenate(weights)
    patch = PATCH * radius * float(np.median([1.0 / grid.camera.fx for grid in cells]))
    _, group = np.unique(np.floor(place / patch).astype(np.int64), axis=0, return_inverse=True)
    group = group.reshape(-1)
    total = np.bincount(group, weight)[:, None]
    mean = np.stack([np.bincount(group, weight * column) for column in place.T], axis=1) / total
    shade = np.stack([np.bincount(group, weight * column) for column in color.T], axis=1) / total
    return middle + mean, (shade + 0.5).astype(np.uint8)
