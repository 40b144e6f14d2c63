"""Which of many points a camera sees: those that none of the others hides."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from splatmill_worker.scene import Camera, Projection

PER_CELL = 8.0
"""Points of a cell of the depth buffer, on average: with fewer, what lies behind shows through the front."""

SLANT = 3.0
"""Tangent of the angle between a surface and the picture up to which its points do not hide each other."""

SLACK = 0.02
"""Share of the depth by which points of one surface may lie behind each other by their noise."""


def visible(camera: Camera, projection: Projection) -> npt.NDArray[np.intp]:
    """Rows of the points that fall on the photo of `camera` and that no other of them hides.

    projection: where the points fall. The nearest point in a cell hides what lies behind it; the cells are as small as
        the number of points allows.
    """
    rows = np.flatnonzero(projection.inside)
    if not len(rows):
        return rows
    cell = max(1.0, math.sqrt(PER_CELL * camera.width * camera.height / len(rows)))
    across = math.ceil(camera.width / cell)
    at = (projection.rows[rows] / cell).astype(np.int64) * across + (projection.columns[rows] / cell).astype(
        np.int64
    )
    nearest = np.full(at.max() + 1, np.inf)
    np.minimum.at(nearest, at, projection.depths[rows])
    limit = nearest[at] * (1.0 + SLACK + SLANT * cell / min(camera.fx, camera.fy))
    return rows[projection.depths[rows] <= limit]
