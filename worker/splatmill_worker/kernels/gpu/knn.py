"""Mean distance to the three nearest other points, by trying every pair: N^2 plain arithmetic suits a GPU."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from ..reference.knn import NEIGHBORS, check_points
from . import device
from .launch.argument import Float, Floats, Int
from .launch.constant import constant

ROWS = 64
"""Points per program."""

OTHERS = 64
"""Points that they are compared with at a time."""

FAR = constant(float("inf"))


@triton.jit
def knn_kernel(
    points: Floats, result: Floats, count: Int, nearest: Float, ROWS: tl.constexpr, OTHERS: tl.constexpr
):
    """Write the mean distance of each point to its `nearest` (1 to 3) nearest others."""
    i = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    here = i < count
    x = tl.load(points + i * 3, mask=here, other=0.0)
    y = tl.load(points + i * 3 + 1, mask=here, other=0.0)
    z = tl.load(points + i * 3 + 2, mask=here, other=0.0)
    first = tl.zeros([ROWS], tl.float32) + FAR
    second = first
    third = first
    for start in tl.range(0, count, OTHERS):
        j = start + tl.arange(0, OTHERS)
        there = j < count
        dx = x[:, None] - tl.load(points + j * 3, mask=there, other=0.0)[None, :]
        dy = y[:, None] - tl.load(points + j * 3 + 1, mask=there, other=0.0)[None, :]
        dz = z[:, None] - tl.load(points + j * 3 + 2, mask=there, other=0.0)[None, :]
        squared = dx * dx + dy * dy + dz * dz
        squared = tl.where(there[None, :] & (i[:, None] != j[None, :]), squared, FAR)
        for _ in tl.static_range(3):
            # Take exactly one smallest entry out of the block, also where several are equal, and sort it in.
            small = tl.min(squared, axis=1)
            which = tl.min(tl.where(squared == small[:, None], tl.arange(0, OTHERS)[None, :], OTHERS), axis=1)
            squared = tl.where(tl.arange(0, OTHERS)[None, :] == which[:, None], FAR, squared)
            moved = tl.maximum(first, small)
            first = tl.minimum(first, small)
            third = tl.minimum(third, tl.maximum(second, moved))
            second = tl.minimum(second, moved)
    total = tl.sqrt_rn(first)
    total += tl.where(nearest > 1, tl.sqrt_rn(second), 0.0)
    total += tl.where(nearest > 2, tl.sqrt_rn(third), 0.0)
    tl.store(result + i, total / nearest, mask=here)


@torch.no_grad()
def knn(points: Tensor) -> Tensor:
    """Mean distance [N] from points [N,3] to their three nearest others, as `reference.knn` defines it."""
    device.require(points)
    check_points(points)
    count = points.shape[0]
    points = points.float().contiguous()
    result = torch.empty(count, device=points.device, dtype=torch.float32)
    nearest = float(min(NEIGHBORS, count - 1))
    knn_kernel[(triton.cdiv(count, ROWS),)](points, result, count, nearest, ROWS=ROWS, OTHERS=OTHERS)
    return result
