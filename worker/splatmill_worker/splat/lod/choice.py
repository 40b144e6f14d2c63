"""Chooses what a view draws of a model in levels of detail: for each leaf in view a level, or none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatmill_worker.scene import Camera

TOLERANCE = 0.25
"""Pixels by which what is seen may be drawn from its place, root mean square (decisions: levels-in-view)."""

BESIDE = 2.0
"""Pixels beside the picture of which something may reach into it, as projection widens every Gaussian. Large ones seen
far from the axis are widened further; their edges are left out."""

NEAREST = 0.05
"""Least distance at which the errors of a leaf are seen, over the diagonal of its box, wherever the camera is."""

Float = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Leaves:
    """The leaves of a model in levels of detail.

    low, high: corners of their boxes [leaves, 3], world units.
    errors: of each level [leaves, levels], world units (`Level.errors`).
    counts: Gaussians of each level [leaves, levels].
    """

    low: Float
    high: Float
    errors: Float
    counts: npt.NDArray[np.int64]


@dataclass(frozen=True)
class Choice:
    """What a view draws.

    levels: of each leaf, int64 [leaves]; -1 for one that is not in view.
    tolerance: pixels; larger than asked for where finer levels are more Gaussians than are allowed. Leaves nearer than
        NEAREST are taken to be there.
    """

    levels: npt.NDArray[np.int64]
    tolerance: float


def choose(leaves: Leaves, camera: Camera, most: int, tolerance: float = TOLERANCE) -> Choice:
    """For each leaf in view, the coarsest level that is drawn within `tolerance` pixels of its place.

    most: Gaussians of all leaves together, above which the tolerance is doubled, until all have the coarsest level.
    """
    visible = in_view(leaves, camera)
    centre = camera.center
    away = np.linalg.norm(np.maximum(np.maximum(leaves.low - centre, centre - leaves.high), 0.0), axis=1)
    away = np.maximum(away, NEAREST * np.linalg.norm(leaves.high - leaves.low, axis=1))
    shifts = leaves.errors * max(camera.fx, camera.fy) / np.maximum(away, 1e-30)[:, None]
    shifts[:, 0] = 0.0  # there is nothing finer
    shifts = np.maximum.accumulate(shifts, axis=1)
    coarsest = leaves.errors.shape[1] - 1
    everywhere = np.arange(len(visible))
    while True:
        levels = np.where(visible, (shifts <= tolerance).sum(axis=1) - 1, -1)
        drawn = leaves.counts[everywhere, levels][visible].sum()
        if drawn <= most or bool((levels[visible] == coarsest).all()):
            return Choice(levels, tolerance)
        tolerance *= 2


def in_view(leaves: Leaves, camera: Camera) -> npt.NDArray[np.bool_]:
    """Whether a box reaches into the view, or may: one that crosses planes of several sides counts."""
    rotation, translation = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    right = camera.width - camera.cx + BESIDE
    below = camera.height - camera.cy + BESIDE
    planes = np.array(
        [
            [0.0, 0.0, 1.0],
            [camera.fx, 0.0, camera.cx + BESIDE],
            [-camera.fx, 0.0, right],
            [0.0, camera.fy, camera.cy + BESIDE],
            [0.0, -camera.fy, below],
        ]
    )
    normals, offsets = planes @ rotation, planes @ translation
    # The corner that is furthest along each normal.
    furthest = np.where(normals[:, None] > 0, leaves.high, leaves.low)
    return np.asarray((np.einsum("plx,px->pl", furthest, normals) + offsets[:, None] > 0).all(axis=0))
