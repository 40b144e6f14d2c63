"""What photos show where the reconstruction has no points: a first guess of where that stands."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatmill_worker.splat.start.cells import Cells, Flags, Float, Index, Pixels, marked, projected
from splatmill_worker.splat.start.sky import sky_of

NEIGHBOURS = 3
"""Points whose inverse depths are averaged; it is inverse depth that is linear in pixels on a plane."""

AGREES = 1.5
"""Two depths within this factor are taken for the same surface."""


def gap_share(cells: Sequence[Cells]) -> float:
    """Share of what the photos show, sky apart, with no point of the reconstruction in the cell or beside it."""
    ground = sum(int((grid.used & ~sky_of(grid.color, grid.used)).sum()) for grid in cells)
    return sum(int(_gaps(grid).sum()) for grid in cells) / max(1, ground)


def gap_points(cells: Sequence[Cells]) -> tuple[Float, Pixels]:
    """Points [k, 3] and colours [k, 3] behind the cells that have neither sky nor a point.

    Each is put at the mean inverse depth of the nearest points in its photo. Photo after photo: where the new points
    of earlier photos lie already, at about that depth, none are added.
    """
    points: list[Float] = [np.empty((0, 3))]
    colors: list[Pixels] = [np.empty((0, 3), np.uint8)]
    for grid in cells:
        rows = np.argwhere(_gaps(grid))
        if not len(rows) or len(grid.points) < NEIGHBOURS:
            continue
        depth = _depths(_one_per_cell(grid.points), rows)
        wanted = np.full(grid.covered.shape, np.inf)
        wanted[rows[:, 0], rows[:, 1]] = depth
        earlier = projected(grid.camera, np.concatenate(points))
        there = wanted[earlier[:, 1].astype(np.int64), earlier[:, 0].astype(np.int64)]
        agree = (earlier[:, 2] < AGREES * there) & (earlier[:, 2] > there / AGREES)
        taken = marked(earlier[agree], grid.color.shape[:2], spread=0)
        free = ~taken[rows[:, 0], rows[:, 1]]
        points.append(grid.at(rows[free], depth[free]))
        colors.append(grid.color[rows[free, 0], rows[free, 1]])
    return np.concatenate(points), np.concatenate(colors)


def _gaps(grid: Cells) -> Flags:
    return grid.used & ~grid.covered & ~sky_of(grid.color, grid.used)


def _one_per_cell(points: Float) -> Float:
    """Rows of `points` (column, row, depth) with no two in the same cell: stereo gives thousands."""
    _, first = np.unique(points[:, :2].astype(np.int64), axis=0, return_index=True)
    rows: Float = points[first]
    return rows


def _depths(points: Float, rows: Index) -> Float:
    """Depth [k] of cells (row, column) [k, 2] from the nearest of `points` (column, row, depth)."""
    apart = np.square(rows[:, None, ::-1] + 0.5 - points[None, :, :2]).sum(axis=2)
    few = min(NEIGHBOURS, len(points))
    near = np.argpartition(apart, few - 1, axis=1)[:, :few]
    inverse: Float = (1.0 / points[near, 2]).mean(axis=1)
    return 1.0 / inverse
