"""Cells: boxes of space that hold every point once, with about as much of the scene in each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float64]

EXTENT = (0.05, 0.95)
"""Quantiles of the positions along an axis between which a cell is measured, to find its longest axis: a few far
Gaussians lie much farther out than the scene."""


@dataclass(frozen=True)
class Cell:
    """A box of the training world with sides that may be infinite. A point on a side that two cells share is in one.

    low, high: corners [3]; a point x is inside where low <= x < high.
    """

    low: Float
    high: Float

    def holds(self, points: Float, margin: float = 0.0) -> npt.NDArray[np.bool_]:
        """Which of the points [N, 3] lie in the cell, or at most `margin` outside of each side."""
        inside = (points >= self.low - margin) & (points < self.high + margin)
        held: npt.NDArray[np.bool_] = np.logical_and.reduce(inside, axis=1)
        return held

    def touches(self, other: Cell) -> bool:
        """Whether the cells share a point of their sides."""
        return bool(((self.low <= other.high) & (other.low <= self.high)).all())

    def as_dict(self) -> dict[str, list[float | None]]:
        """The corners as lists for JSON, with None for an infinite coordinate."""
        return {
            name: [_finite(x) for x in corner] for name, corner in (("low", self.low), ("high", self.high))
        }

    @staticmethod
    def from_dict(values: dict[str, Any]) -> Cell:
        """The cell of `as_dict`."""
        low, high = (
            np.array([outside if x is None else x for x in values[name]], np.float64)
            for name, outside in (("low", -np.inf), ("high", np.inf))
        )
        return Cell(low, high)


def divide(points: Float, weights: Float, count: int) -> list[Cell]:
    """`count` cells that cover all of space, with about equal sums of the weights [N] of the points [N, 3].

    The cell with the largest sum is divided at its weighted median, across its longest axis, until there are enough.
    A cell of points that all coincide is not divided, so that there may be fewer cells.
    """
    everywhere = Cell(np.full(3, -np.inf), np.full(3, np.inf))
    whole = [(everywhere, np.arange(len(points)))]
    done: list[Cell] = []
    while whole and len(whole) + len(done) < count:
        cell, inside = whole.pop(max(range(len(whole)), key=lambda index: weights[whole[index][1]].sum()))
        parts = _halves(cell, inside, points, weights)
        if parts is None:
            done.append(cell)
        else:
            whole += parts
    return sorted([*done, *(cell for cell, _ in whole)], key=lambda cell: (*cell.low, *cell.high))


def _halves(
    cell: Cell, inside: npt.NDArray[np.intp], points: Float, weights: Float
) -> list[tuple[Cell, npt.NDArray[np.intp]]] | None:
    """The two halves of a cell with the indices of their points; None where no plane divides these."""
    if len(inside) < 2:
        return None
    held = points[inside]
    low, high = np.quantile(held, EXTENT, axis=0)
    for axis in np.argsort(-(high - low), kind="stable"):
        order = np.argsort(held[:, axis], kind="stable")
        sums = np.cumsum(weights[inside][order])
        position = held[order[np.searchsorted(sums, sums[-1] / 2)], axis]
        above = held[:, axis] >= position
        if above.all():  # the median is the least value: divide above it
            greater = held[held[:, axis] > position, axis]
            if not len(greater):
                continue
            position = greater.min()
            above = held[:, axis] >= position
        end, start = cell.high.copy(), cell.low.copy()
        end[axis] = start[axis] = position
        return [(Cell(cell.low, end), inside[~above]), (Cell(start, cell.high), inside[above])]
    return None


def _finite(x: float) -> float | None:
    return float(x) if np.isfinite(x) else None
