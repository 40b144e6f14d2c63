"""Points thinned evenly in space, to one point a cell of a grid."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from splatmill_worker.scene import Float

SEARCHES = 24
"""Sizes of cells that are tried for a number of points."""


def spread(points: Float, most: int) -> npt.NDArray[np.intp]:
    """Rows of `points` [n,3], one of each cell of a grid whose cells are as large as leaves at most `most` of them."""
    if len(points) <= most:
        return in_cells(points, 0.0)
    low, high = 0.0, float(np.ptp(points, axis=0).max())
    rows = in_cells(points, high)
    for _ in range(SEARCHES):
        cell = 0.5 * (low + high) if low > 0.0 else high / 4.0
        trial = in_cells(points, cell)
        if len(trial) > most:
            low = cell
        else:
            high, rows = cell, trial
            if len(trial) > 0.9 * most:
                break
    return rows


def in_cells(points: Float, cell: float | Float) -> npt.NDArray[np.intp]:
    """Rows, in order, of the first of `points` [n,3] in each cell of a grid; with a size of 0, of the distinct points.

    cell: size of the cells, or one for each point [n]. Cells of different sizes hold no point in common.
    """
    sizes = np.broadcast_to(np.asarray(cell, np.float64), (len(points),))
    keys = points.astype(np.float64).copy()
    positive = sizes > 0.0
    keys[positive] = np.floor((points[positive] - points.min(axis=0)) / sizes[positive, None])
    table = np.column_stack([keys, sizes])
    order = np.lexsort(table.T)
    ordered = table[order]
    first = np.ones(len(order), bool)
    first[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    rows: npt.NDArray[np.intp] = np.sort(order[first])
    return rows
