"""Mean distance from each point to its three nearest others."""

from __future__ import annotations

import torch
from torch import Tensor

NEIGHBORS = 3
"""Nearest other points whose distances are averaged."""


@torch.no_grad()
def knn(points: Tensor) -> Tensor:
    """Return the mean distance [N] from each of points [N,3] to its three nearest others, by trying every pair.

    Duplicates are other points at distance 0. With fewer than four points the mean is over those there are.
    Raises ValueError for a single point, which has no neighbour, and for points that are not finite.
    """
    check_points(points)
    n = points.shape[0]
    k = min(NEIGHBORS, n - 1)
    result = points.new_zeros(n)
    for start in range(0, n, 512):
        rows = points[start : start + 512]
        squared = ((rows[:, None] - points[None]) ** 2).sum(2)
        squared[torch.arange(rows.shape[0]), torch.arange(start, start + rows.shape[0])] = float("inf")
        result[start : start + 512] = squared.topk(k, dim=1, largest=False).values.sqrt().mean(1)
    return result


def check_points(points: Tensor) -> None:
    """Raise ValueError for a wrong shape or dtype, a single point, or a coordinate that is not finite."""
    if points.dim() != 2 or points.shape[1] != 3:
        raise ValueError(f"points: expected shape [N, 3], got {list(points.shape)}")
    if not points.is_floating_point():
        raise ValueError(f"points: expected a floating dtype, got {points.dtype}")
    if points.shape[0] == 1:
        raise ValueError("points: a single point has no neighbour; give at least two")
    bad = torch.nonzero(~torch.isfinite(points).all(1))
    if bad.numel():
        row = int(bad[0])
        raise ValueError(f"points: row {row} is {points[row].tolist()}; every coordinate must be finite")
