"""median_depth by one program per tile, which walks its list until every pixel has blended half of its light."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from ..records import NEAREST_HORIZON, TILE, Bins, Projected
from . import device, record
from .device_functions.blend import LEAST, MOST, PIXELS, along_factor, raw_alpha, tile_pixels
from .launch.argument import Float, Floats, Int, Ints, Longs
from .launch.constant import constant
from .record import DEPTH, FACTOR_UX, FACTOR_UY, FACTOR_VY, LEVEL, MEAN_X, MEAN_Y, STRIDE

HORIZON = constant(NEAREST_HORIZON)


@triton.jit
def median_depth_kernel(
    records: Floats, tilts: Floats, offsets: Longs, ids: Ints, depth: Floats, transmittance: Float,
    width: Int, height: Int, columns: Int,
):  # fmt: skip
    """Write the median depth of one tile's pixels. A finished pixel has a transmittance of 0."""
    tile = tl.program_id(0)
    column, row = tile_pixels(tile, columns)
    x = column.to(tl.float32) + 0.5
    y = row.to(tl.float32) + 0.5
    inside = (column < width) & (row < height)
    start = tl.load(offsets + tile)
    count = (tl.load(offsets + tile + 1) - start).to(tl.int32)
    through = tl.where(inside, 1.0, 0.0)
    deep = tl.zeros([PIXELS], tl.float32)
    done = 0
    most = tl.max(through, 0)
    while (done < count) & (most > 0.0):
        splat = tl.load(ids + start + done).to(tl.int64)
        source = records + splat * STRIDE
        dx = x - tl.load(source + MEAN_X)
        dy = y - tl.load(source + MEAN_Y)
        u, v = along_factor(
            dx, dy, tl.load(source + FACTOR_UX), tl.load(source + FACTOR_UY), tl.load(source + FACTOR_VY)
        )
        alpha = tl.minimum(raw_alpha(u, v, tl.load(source + LEVEL)), MOST)
        after = through - alpha * through
        shown = (alpha >= LEAST) & (through > 0.0)
        passed = shown & (after <= transmittance)
        nearness = 1.0 - dx * tl.load(tilts + splat * 2) - dy * tl.load(tilts + splat * 2 + 1)
        deep = tl.where(passed & (nearness > HORIZON), tl.load(source + DEPTH) / nearness, deep)
        through = tl.where(passed, 0.0, tl.where(shown, after, through))
        most = tl.max(through, 0)
        done += 1
    tl.store(depth + row * width + column, deep, mask=inside)


@torch.no_grad()
def median_depth(
    projected: Projected, bins: Bins, width: int, height: int, *, tilts: Tensor, transmittance: float
) -> Tensor:
    """Return the median depth [H,W], as `reference.median_depth` defines it."""
    device.require(projected.means2d)
    columns, rows = -(-width // TILE), -(-height // TILE)
    depth = torch.empty(height, width, device=projected.means2d.device, dtype=torch.float32)
    median_depth_kernel[(columns * rows,)](
        record.pack(projected), tilts.contiguous(), bins.offsets, bins.ids, depth, float(transmittance), width, height,
        columns,
        num_warps=2,
    )  # fmt: skip
    return depth
