"""The gradient of compositing, front to back: one program per segment of a tile's list, started from its
checkpoint.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from ..records import TILE, Bins
from .blend import MOST, PIXELS, STOP, STRIDE, advance, alpha_of, tile_pixels
from .blended import SEGMENT, Blended
from .constant import constant
from .record import GRADIENT_WIDTH
from .tuning import COMPOSITE_BACKWARD, autotune

GRADIENT_STRIDE = constant(GRADIENT_WIDTH)


@triton.jit
def pick(k, which: tl.constexpr, value, others):
    """`value` in the slot `which` of a gradient record, `others` in the rest."""
    return tl.where(k == which, value, others)


@autotune(COMPOSITE_BACKWARD, key=["DEPTH", "SCORES"], reset=["gradient"])
@triton.jit
def composite_backward_kernel(
    records, offsets, ids, color, transmittance, depth, checkpoints, first_segment, segment_tile,
    d_color, d_alpha, d_depth, gradient, width, height, columns,
    ALPHA: tl.constexpr, DEPTH: tl.constexpr, SCORES: tl.constexpr, SEGMENT: tl.constexpr, BATCH: tl.constexpr,
):  # fmt: skip
    segment = tl.program_id(0)
    tile = tl.load(segment_tile + segment)
    if tile < 0:
        return
    column, row = tile_pixels(tile, columns)
    x = column.to(tl.float32) + 0.5
    y = row.to(tl.float32) + 0.5
    inside = (column < width) & (row < height)
    pixel = tl.arange(0, PIXELS)
    out = row * width + column
    g_red = tl.load(d_color + out * 3, mask=inside, other=0.0)
    g_green = tl.load(d_color + out * 3 + 1, mask=inside, other=0.0)
    g_blue = tl.load(d_color + out * 3 + 2, mask=inside, other=0.0)

    # All that follows a splat enters its alpha's gradient through one number per pixel: sum over j > i of w_j
    # (c_j . g), plus the transmittance left times (background . g - d_alpha). `behind` starts as the whole
    # and loses what was passed.
    behind = tl.load(color + out * 3, mask=inside, other=0.0) * g_red
    behind += tl.load(color + out * 3 + 1, mask=inside, other=0.0) * g_green
    behind += tl.load(color + out * 3 + 2, mask=inside, other=0.0) * g_blue
    if ALPHA:
        left_over = tl.load(transmittance + out, mask=inside, other=0.0)
        behind -= left_over * tl.load(d_alpha + out, mask=inside, other=0.0)
    g_depth = tl.zeros([PIXELS], tl.float32)
    if DEPTH:
        g_depth = tl.load(d_depth + out, mask=inside, other=0.0)
        behind += tl.load(depth + out, mask=inside, other=0.0) * g_depth

    place = checkpoints + segment.to(tl.int64) * (5 * PIXELS) + pixel
    through = tl.load(place + 3 * PIXELS)
    behind -= (
        tl.load(place) * g_red + tl.load(place + PIXELS) * g_green + tl.load(place + 2 * PIXELS) * g_blue
    )
    if DEPTH:
        behind -= tl.load(place + 4 * PIXELS) * g_depth

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
            dx = x - tl.load(source)
            dy = y - tl.load(source + 1)
            a, b, c = tl.load(source + 2), tl.load(source + 3), tl.load(source + 4)
            opacity = tl.load(source + 5, mask=listed, other=0.0)
            alpha = alpha_of(dx, dy, a, b, c, opacity)
            before = through
            weight, through, kept = advance(before, alpha)
            shine = tl.load(source + 6) * g_red + tl.load(source + 7) * g_green + tl.load(source + 8) * g_blue
            if DEPTH:
                shine += tl.load(source + 9) * g_depth
            behind -= weight * shine
            d_alpha_here = before * shine - behind / (1.0 - alpha)
            # Where alpha is clamped, no gradient flows to opacity, conic or mean.
            pull = tl.where(kept & (alpha < MOST), alpha * d_alpha_here, 0.0)
            pull_x, pull_y = pull * dx, pull * dy
            sum_x, sum_y = tl.sum(pull_x, axis=0), tl.sum(pull_y, axis=0)

            # One record of sums, and so one coalesced atomic per tile and splat.
            sums = pick(k, 0, a * sum_x + b * sum_y, tl.zeros([GRADIENT_STRIDE], tl.float32))
            sums = pick(k, 1, b * sum_x + c * sum_y, sums)
            sums = pick(k, 2, -0.5 * tl.sum(pull_x * dx, axis=0), sums)
            sums = pick(k, 3, -tl.sum(pull_x * dy, axis=0), sums)
            sums = pick(k, 4, -0.5 * tl.sum(pull_y * dy, axis=0), sums)
            sums = pick(k, 5, tl.sum(pull, axis=0) / tl.maximum(opacity, 1e-30), sums)
            sums = pick(k, 6, tl.sum(weight * g_red, axis=0), sums)
            sums = pick(k, 7, tl.sum(weight * g_green, axis=0), sums)
            sums = pick(k, 8, tl.sum(weight * g_blue, axis=0), sums)
            if DEPTH:
                sums = pick(k, 9, tl.sum(weight * g_depth, axis=0), sums)
            if SCORES:
                sums = pick(k, 10, tl.sum(tl.abs(a * pull_x + b * pull_y), axis=0), sums)
                sums = pick(k, 11, tl.sum(tl.abs(b * pull_x + c * pull_y), axis=0), sums)
            target = gradient + splat.to(tl.int64) * GRADIENT_STRIDE + k
            tl.atomic_add(target, sums, mask=listed & (k < 12), sem="relaxed")
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
    scores: bool = False,
) -> Tensor:
    """Gradient records [N, 16] (see `record`) of one view; with `scores` the densification sums are filled too."""
    if made.checkpoints is None or made.segment_tile is None:
        raise ValueError(
            "the view was composited without checkpoints; composite it again with them to differentiate it"
        )
    gradient = torch.zeros(records.shape[0], GRADIENT_WIDTH, device=records.device, dtype=torch.float32)
    composite_backward_kernel[(made.segment_tile.shape[0],)](
        records, bins.offsets, bins.ids, made.color, made.transmittance, made.depth, made.checkpoints,
        made.first_segment, made.segment_tile, d_color.contiguous(),
        None if d_alpha is None else d_alpha.contiguous(),
        None if d_depth is None else d_depth.contiguous(), gradient,
        width, height, -(-width // TILE),
        ALPHA=d_alpha is not None, DEPTH=d_depth is not None,
        SCORES=scores, SEGMENT=SEGMENT,
    )  # fmt: skip
    return gradient
