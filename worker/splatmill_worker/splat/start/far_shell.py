"""A far shell of Gaussians behind the scene, for the sky and for background without points (decisions: far-shell)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatmill_worker.splat.start.cells import Cells, Float, Pixels

DISTANCE = 5.0
"""Radius of the shell, over the distance from the cameras' mean within which nine points in ten lie."""

OPACITY = 0.7
"""Opacity of the shell at the first step: high, because there is nothing behind it to show through."""

PATCH_CELLS = 2.0
"""Side of the patch that becomes a Gaussian, in cells (decisions: PATCH_CELLS)."""

BORDER_CELLS = 6
"""Cells by which every photo is extended past its border, because held-out photos show more than the others."""

BORDER_WEIGHT = 0.05
"""Weight of an extended cell's colour in the mean; that of a cell which a photo shows is 1."""


def shell_points(cells: Sequence[Cells], points: Float) -> tuple[Float, Pixels]:
    """Points [k, 3] and colours uint8 [k, 3] on a sphere around the cameras, one per patch, wherever photos look.

    points: those of the reconstruction [n, 3], which set the radius.

    The colour is the mean of what photos show in the direction of the patch, whatever stands in front of it: where the
    sky is seen, that is the colour of the sky, and elsewhere it approximates what is seen through a hole in the scene.
    """
    centers = np.array([grid.camera.center for grid in cells])
    middle = centers.mean(axis=0)
    spread = float(np.linalg.norm(centers - middle, axis=1).max())
    reach = float(np.percentile(np.linalg.norm(points - middle, axis=1), 90)) if len(points) else 0.0
    radius = DISTANCE * max(reach, spread, 1e-6)
    positions, colors, weights = [], [], []
    for grid in cells:
        height, width = grid.used.shape
        extended = (
            np.argwhere(np.ones((height + 2 * BORDER_CELLS, width + 2 * BORDER_CELLS), bool)) - BORDER_CELLS
        )
        # Each cell outside the photo takes the colour and the mask of the nearest cell inside.
        nearest = extended.clip(0, (height - 1, width - 1))
        used = grid.used[nearest[:, 0], nearest[:, 1]]
        extended, nearest = extended[used], nearest[used]
        rays = grid.unproject(extended, np.ones(len(extended))) - grid.camera.center
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        # The intersection of each ray with the sphere: the camera is inside, but not at its centre.
        start = grid.camera.center - middle
        along = rays @ start
        positions.append(start + (np.sqrt(along**2 + radius**2 - start @ start) - along)[:, None] * rays)
        colors.append(grid.color[nearest[:, 0], nearest[:, 1]].astype(np.float64))
        weights.append(np.where((extended == nearest).all(axis=1), 1.0, BORDER_WEIGHT))
    position, color, weight = np.concatenate(positions), np.concatenate(colors), np.concatenate(weights)
    patch = PATCH_CELLS * radius * float(np.median([1.0 / grid.camera.fx for grid in cells]))
    # The three coordinates of a patch as one number, in the same order: sorting rows takes ten times as long.
    most = int(radius / patch) + 2
    place = np.floor(position / patch).astype(np.int64) + most
    _, group = np.unique(np.ravel_multi_index(place.T, (2 * most,) * 3), return_inverse=True)
    total = np.bincount(group, weight)[:, None]
    mean_position = np.stack([np.bincount(group, weight * column) for column in position.T], axis=1) / total
    mean_color = np.stack([np.bincount(group, weight * column) for column in color.T], axis=1) / total
    return middle + mean_position, (mean_color + 0.5).astype(np.uint8)
