"""Gaps: parts of the photos where the reconstruction has no points, and a first guess of their depth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatmill_worker.point_batches import PointBatches
from splatmill_worker.splat.start.cells import Cells, Flags, Float, Index, Pixels, cells_near, projected
from splatmill_worker.splat.start.sky import sky_of

NEIGHBOURS = 3
"""Nearest points whose inverse depths are averaged: on a plane, inverse depth is linear in pixels."""

MAX_DEPTH_RATIO = 1.5
"""Largest ratio of two depths that are taken to be on the same surface."""


def gap_share(cells: Sequence[Cells]) -> float:
    """Share of the photos' area, sky excluded, with no point of the reconstruction in the cell or beside it, 0 to 1."""
    ground = sum(int((grid.used & ~sky_of(grid.color, grid.used)).sum()) for grid in cells)
    return sum(int(_gaps(grid).sum()) for grid in cells) / max(1, ground)


def gap_points(cells: Sequence[Cells]) -> tuple[Float, Pixels]:
    """Points [k, 3] and colours uint8 [k, 3] for the cells that show neither sky nor a point (decisions: gaps).

    A point is placed at the mean inverse depth of the nearest points in its photo. The photos are processed in order:
    a cell gets no point where a gap point of an earlier photo lies in it at about the same depth.
    """
    earlier, points = PointBatches(), [np.empty((0, 3))]
    colors: list[Pixels] = [np.empty((0, 3), np.uint8)]
    for grid in cells:
        rows = np.argwhere(_gaps(grid))
        if not len(rows) or len(grid.points) < NEIGHBOURS:
            continue
        depth = _depths(_one_per_cell(grid.points), rows)
        depths = np.full(grid.covered.shape, np.inf)
        depths[rows[:, 0], rows[:, 1]] = depth
        places = projected(grid.camera, earlier.near(grid.camera))
        # Infinite where the cell is no gap, so that no earlier point agrees there.
        expected = depths[places[:, 1].astype(np.int64), places[:, 0].astype(np.int64)]
        agree = (places[:, 2] < MAX_DEPTH_RATIO * expected) & (places[:, 2] > expected / MAX_DEPTH_RATIO)
        taken = cells_near(places[agree], grid.color.shape[:2], spread=0)
        free = ~taken[rows[:, 0], rows[:, 1]]
        points.append(grid.unproject(rows[free], depth[free]))
        earlier.add(points[-1])
        colors.append(grid.color[rows[free, 0], rows[free, 1]])
    return np.concatenate(points), np.concatenate(colors)


def _gaps(grid: Cells) -> Flags:
    """bool [h, w]: cells that show neither sky nor a point."""
    return grid.used & ~grid.covered & ~sky_of(grid.color, grid.used)


def _one_per_cell(points: Float) -> Float:
    """Rows of `points` (column, row, depth), at most one per cell: the search for neighbours compares all pairs."""
    _, first = np.unique(points[:, :2].astype(np.int64), axis=0, return_index=True)
    rows: Float = points[first]
    return rows


def _depths(points: Float, rows: Index) -> Float:
    """Depths [k] of the cells `rows` [k, 2] (row, column) from the nearest of `points` (column, row, depth)."""
    apart = np.square(rows[:, None, 1] + 0.5 - points[:, 0]) + np.square(
        rows[:, None, 0] + 0.5 - points[:, 1]
    )
    few = min(NEIGHBOURS, len(points))
    near = np.argpartition(apart, few - 1, axis=1)[:, :few]
    inverse: Float = (1.0 / points[near, 2]).mean(axis=1)
    return 1.0 / inverse
