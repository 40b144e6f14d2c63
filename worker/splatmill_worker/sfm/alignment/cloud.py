"""A cloud of points that nearest neighbours are searched in, thinned to one point a cell of a grid."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from splatmill_worker.scene import Float
from splatmill_worker.sfm.alignment.cells import spread

LIBRARY = "scipy"
"""The module with the search tree."""

Levels = npt.NDArray[np.int16]

ALIKE = 20
"""Grey levels of 255 by which each channel of two points of one colour may differ, as a point and a photo may
(`posed.judged.evidence.TOLERANCE`)."""


@dataclass(frozen=True)
class Cloud:
    """n points with a search tree.

    points: [n,3].
    colors: RGB in levels of 255 [n,3].
    tree: scipy's cKDTree of the points.
    spacing: median distance of a point from its nearest neighbour.
    radius: median distance of the points from their median.
    """

    points: Float
    colors: Levels
    tree: Any
    spacing: float
    radius: float

    @staticmethod
    def of(points: Float, colors: npt.NDArray[Any]) -> Cloud:
        """The cloud of two points or more. Raises ImportError without scipy."""
        from scipy.spatial import cKDTree

        tree = cKDTree(points)
        nearest = tree.query(points, k=2)[0][:, 1]
        radius = float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))
        return Cloud(points, colors.astype(np.int16), tree, float(np.median(nearest)), radius)

    def thinned(self, most: int) -> Cloud:
        """The cloud with about `most` points at most, spread evenly in space."""
        rows = spread(self.points, most)
        if len(rows) == len(self.points):
            return self
        return Cloud.of(self.points[rows], self.colors[rows])

    def alike(self, rows: npt.NDArray[np.intp], colors: Levels) -> npt.NDArray[np.bool_]:
        """Whether the points `rows` [n,k] have the colours [n,3]. False for a row past the end."""
        flags: npt.NDArray[np.bool_] = rows < len(self.points)
        kept = np.minimum(rows, len(self.points) - 1)
        # A channel at a time, in a fourth of the time of all three.
        for own, other in zip(self.colors.T, colors.T, strict=True):
            flags &= np.abs(own[kept] - other[:, None]) <= ALIKE
        return flags


def degenerate(points: Float) -> str | None:
    """Why no similarity follows from the distinct points [n,3], as the end of a sentence; None where one does."""
    if len(points) < 4:
        return f"it has {len(points)} distinct points"
    around = points - points.mean(axis=0)
    spreads = np.linalg.svd(around, compute_uv=False) / math.sqrt(len(points))
    if not spreads[1] > 1e-3 * spreads[0]:
        return "all of its points lie on a line"
    return None
