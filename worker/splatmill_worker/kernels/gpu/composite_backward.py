"""The gradient of compositing, front to back: one program per segment of a tile's list, starting at its checkpoint."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from ..records import TILE, Bins
from .blended import SEGMENT, Blended
from .device_functions.blend import (
    MOST,
    PIXELS,
    STOP,
    advance,
    along_factor,
    checkpoint_of,
    load_checkpoint,
    raw_alpha,
    tile_pixels,
)
from .device_functions.projection import LN2
from .launch.argument import Floats, Int, Ints, Longs
from .launch.tuning import COMPOSITE_BACKWARD, autotune, magnitude
from .record import (
    BLUE,
    DEPTH,
    DIFFERENTIABLE,
    FACTOR_UX,
    FACTOR_UY,
    FACTOR_VY,
    GRADIENT_STRIDE,
    GRADIENT_WIDTH,
    GREEN,
    LEVEL,
    MEAN_X,
    MEAN_Y,
    NOTHING,
    RED,
    STRIDE,
    SUM_Q,
    SUM_QUU,
    SUM_QUV,
    SUM_QVV,
)


@triton.jit
def pick(k, which: tl.constexpr, value, others):
    """`value` in the slot `which` of a gradient record, `others` in the rest."""
    return tl.where(k == which, value, others)


@autotune(COMPOSITE_BACKWARD, key=["WITH_DEPTH", "magnitude"], reset=["gradient"])
@triton.jit(do_not_specialize=["magnitude"])
def composite_backward_kernel(
    records: Floats, offsets: Longs, ids: Ints, color: Floats, transmittance: Floats, depth: Floats,
    checkpoints: Floats, first_segment: Ints, segment_tile: Ints, d_color: Floats, d_alpha: Floats, d_depth: Floats,
    gradient: Floats, width: Int, height: Int, columns: Int, magnitude: Int,
    WITH_ALPHA: tl.constexpr, WITH_DEPTH: tl.constexpr, SEGMENT: tl.constexpr, BATCH: tl.constexpr,
):  # fmt: skip
    segment = tl.program_id(0)
    tile = tl.load(segment_tile + segment)
    if tile < 0:
        return
    column, row = tile_pixels(tile, columns)
    x = column.to(tl.float32) + 0.5
    y = row.to(tl.float32) + 0.5
    inside = (column < width) & (row < height)
    out = row * width + column
    g_red = tl.load(d_color + out * 3, mask=inside, other=0.0)
    g_green = tl.load(d_color + out * 3 + 1, mask=inside, other=0.0)
    g_blue = tl.load(d_color + out * 3 + 2, mask=inside, other=0.0)

    # What lies behind splat i enters the gradient of its alpha as one number per pixel: the sum over j > i of
    # w_j (c_j . g), plus the transmittance left times (background . g - d_alpha). `behind` starts as the sum over all
    # splats; the terms of the splats passed are subtracted.
    behind = tl.load(color + out * 3, mask=inside, other=0.0) * g_red
    behind += tl.load(color + out * 3 + 1, mask=inside, other=0.0) * g_green
    behind += tl.load(color + out * 3 + 2, mask=inside, other=0.0) * g_blue
    if WITH_ALPHA:
        left_over = tl.load(transmittance + out, mask=inside, other=0.0)
        behind -= left_over * tl.load(d_alpha + out, mask=inside, other=0.0)
    g_depth = tl.zeros([PIXELS], tl.float32)
    if WITH_DEPTH:
        g_depth = tl.load(d_depth + out, mask=inside, other=0.0)
        behind += tl.load(depth + out, mask=inside, other=0.0) * g_depth

    red, green, blue, through, deep = load_checkpoint(checkpoint_of(checkpoints, segment), WITH_DEPTH)
    behind -= red * g_red + green * g_green + blue * g_blue
    if WITH_DEPTH:
        behind -= deep * g_depth

    start = tl.load(offsets + tile)
    count = (tl.load(offsets + tile + 1) - start).to(tl.int32)
    done = (segment - tl.load(first_segment + tile)) * SEGMENT
    end = tl.minimum(done + SEGMENT, count)
    k = tl.arange(0, GRADIENT_STRIDE)
    most = tl.max(through, 0)
    while (done < end) & (most > STOP):
        for j in tl.static_range(BATCH):
            listed = done + j < end
            splat = tl.load(ids + start + done + j, mask=listed, other=0)
            source = records + splat.to(tl.int64) * STRIDE
            dx = x - tl.load(source + MEAN_X)
            dy = y - tl.load(source + MEAN_Y)
            ux, uy = tl.load(source + FACTOR_UX), tl.load(source + FACTOR_UY)
            vy = tl.load(source + FACTOR_VY)
            u, v = along_factor(dx, dy, ux, uy, vy)
            raw = raw_alpha(u, v, tl.load(source + LEVEL, mask=listed, other=NOTHING))
            alpha = tl.minimum(raw, MOST)
            before = through
            weight, through, kept = advance(before, alpha)
            shine = tl.load(source + RED) * g_red + tl.load(source + GREEN) * g_green
            shine += tl.load(source + BLUE) * g_blue
            if WITH_DEPTH:
                shine += tl.load(source + DEPTH) * g_depth
            gain = weight * shine
            behind -= gain
            # alpha dL/dalpha. Where alpha is clamped, no gradient flows to opacity, factor or mean.
            q = tl.where(kept & (raw <= MOST), gain - behind * (alpha / (1.0 - alpha)), 0.0)
            qu, qv = q * u, q * v
            sum_u, sum_v = 2.0 * LN2 * tl.sum(qu, axis=0), 2.0 * LN2 * tl.sum(qv, axis=0)

            # One record of sums, and so one coalesced atomic per tile and splat.
            sums = pick(k, MEAN_X, ux * sum_u, tl.zeros([GRADIENT_STRIDE], tl.float32))
            sums = pick(k, MEAN_Y, uy * sum_u + vy * sum_v, sums)
            sums = pick(k, SUM_QUU, tl.sum(qu * u, axis=0), sums)
            sums = pick(k, SUM_QUV, tl.sum(qu * v, axis=0), sums)
            sums = pick(k, SUM_QVV, tl.sum(qv * v, axis=0), sums)
            sums = pick(k, SUM_Q, tl.sum(q, axis=0), sums)
            sums = pick(k, RED, tl.sum(weight * g_red, axis=0), sums)
            sums = pick(k, GREEN, tl.sum(weight * g_green, axis=0), sums)
            sums = pick(k, BLUE, tl.sum(weight * g_blue, axis=0), sums)
            if WITH_DEPTH:
                sums = pick(k, DEPTH, tl.sum(weight * g_depth, axis=0), sums)
            target = gradient + splat.to(tl.int64) * GRADIENT_STRIDE + k
            tl.atomic_add(target, sums, mask=listed & (k < DIFFERENTIABLE), sem="relaxed")
        most = tl.max(through, 0)
        done += BATCH


def blend_backward(
    records: Tensor,
    bins: Bins,
    made: Blended,
    width: int,
    height: int,
    d_color: Tensor,
    *,
    d_alpha: Tensor | None = None,
    d_depth: Tensor | None = None,
) -> Tensor:
    """Return the gradient records [N, 16] (see `record`) of one view.

    d_color [H,W,3], d_alpha [H,W] and d_depth [H,W] are the loss's gradients to the image; None counts as 0. Raises
    ValueError for an image that was composited without checkpoints.
    """
    if made.checkpoints is None or made.segment_tile is None:
        raise ValueError(
            "The image was composited without checkpoints and cannot be differentiated; "
            "composite it with checkpoints=True."
        )
    gradient = torch.zeros(records.shape[0], GRADIENT_WIDTH, device=records.device, dtype=torch.float32)
    composite_backward_kernel[(made.segment_tile.shape[0],)](
        records, bins.offsets, bins.ids, made.color, made.transmittance, made.depth, made.checkpoints,
        made.first_segment, made.segment_tile, d_color.contiguous(),
        None if d_alpha is None else d_alpha.contiguous(),
        None if d_depth is None else d_depth.contiguous(), gradient,
        width, height, -(-width // TILE), magnitude(bins.ids.shape[0]),
        WITH_ALPHA=d_alpha is not None, WITH_DEPTH=d_depth is not None, SEGMENT=SEGMENT,
    )  # fmt: skip
    return gradient
