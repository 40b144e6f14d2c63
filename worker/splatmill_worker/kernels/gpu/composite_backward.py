"""The gradient of compositing, front to back: one program per segment of a tile's list, started from its checkpoint."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from ..records import TILE, Bins
from .blend import (
    ALPHA_MAX,
    PIXELS,
    STRIDE,
    TRANSMITTANCE_MIN,
    alphas,
    exponents,
    monomials,
    tf32_part,
    tile_pixels,
)
from .composite import SEGMENT, Blended
from .constant import constant
from .record import GRADIENT_WIDTH
from .tuning import COMPOSITE_BACKWARD, autotune

GRADIENT_STRIDE = constant(GRADIENT_WIDTH)


@autotune(COMPOSITE_BACKWARD, key=["DEPTH", "SCORES"], reset=["gradient"])
@triton.jit
def composite_backward_kernel(
    records, offsets, ids, background, color, transmittance, depth, checkpoints, first_segment, segment_tile,
    d_color, d_alpha, d_depth, errors, gradient, width, height, columns,
    BACKGROUND: tl.constexpr, ALPHA: tl.constexpr, DEPTH: tl.constexpr, SCORES: tl.constexpr, SEGMENT: tl.constexpr,
    BATCH: tl.constexpr, EXPONENT: tl.constexpr, SUMS: tl.constexpr,
):  # fmt: skip
    segment = tl.program_id(0)
    tile = tl.load(segment_tile + segment)
    if tile < 0:
        return
    left, top, column, row = tile_pixels(tile, columns)
    x = column.to(tl.float32) + 0.5
    y = row.to(tl.float32) + 0.5
    inside = (column < width) & (row < height)
    pixel = tl.arange(0, PIXELS)
    out = row * width + column
    g_red = tl.load(d_color + out * 3, mask=inside, other=0.0)
    g_green = tl.load(d_color + out * 3 + 1, mask=inside, other=0.0)
    g_blue = tl.load(d_color + out * 3 + 2, mask=inside, other=0.0)

    # All that follows a splat enters its alpha's gradient through one number per pixel: sum over j > i of w_j (c_j . g),
    # plus the transmittance left times (background . g - d_alpha). `behind` starts as the whole and loses what was passed.
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
    error = tl.zeros([PIXELS], tl.float32)
    if SCORES:
        error = tl.load(errors + out, mask=inside, other=0.0)

    place = checkpoints + segment * (5 * PIXELS) + pixel
    through = tl.load(place + 3 * PIXELS)
    behind -= (
        tl.load(place) * g_red + tl.load(place + PIXELS) * g_green + tl.load(place + 2 * PIXELS) * g_blue
    )
    if DEPTH:
        behind -= tl.load(place + 4 * PIXELS) * g_depth

    start = tl.load(offsets + tile)
    count = (tl.load(offsets + tile + 1) - start).to(tl.int32)
    begin = (segment - tl.load(first_segment + tile)) * SEGMENT
    end = tl.minimum(begin + SEGMENT, count)
    lane = tl.arange(0, BATCH)
    done = begin
    most = tl.max(through, 0)
    while (done < end) & (most > TRANSMITTANCE_MIN):
        here = done + lane
        listed = here < end
        splat = tl.load(ids + start + here, mask=listed, other=0)
        source = records + splat.to(tl.int64) * STRIDE
        mx, my = tl.load(source), tl.load(source + 1)
        a, b, c = tl.load(source + 2), tl.load(source + 3), tl.load(source + 4)
        opacity = tl.load(source + 5, mask=listed, other=0.0)
        red, green, blue = tl.load(source + 6), tl.load(source + 7), tl.load(source + 8)
        sigma = exponents(mx, my, a, b, c, x, y, left, top, EXPONENT, BATCH)
        alpha = alphas(sigma, opacity)
        after = through[None, :] * tl.cumprod(1.0 - alpha, axis=0)
        kept = (after > TRANSMITTANCE_MIN) & (alpha > 0.0)
        inverse = 1.0 / (1.0 - alpha)
        before = after * inverse
        weight = tl.where(kept, alpha * before, 0.0)
        shine = (
            red[:, None] * g_red[None, :]
            + green[:, None] * g_green[None, :]
            + blue[:, None] * g_blue[None, :]
        )
        if DEPTH:
            shine += tl.load(source + 9)[:, None] * g_depth[None, :]
        passed = tl.cumsum(weight * shine, axis=0)
        d_alpha_here = before * shine - (behind[None, :] - passed) * inverse
        # Where alpha is clamped, no gradient flows to opacity, conic or mean.
        pull = tl.where(kept & (alpha < ALPHA_MAX), alpha * d_alpha_here, 0.0)
        behind -= tl.sum(weight * shine, axis=0)
        through = tl.min(after, axis=0)
        most = tl.max(through, 0)
        done += BATCH

        target = gradient + splat.to(tl.int64) * GRADIENT_STRIDE
        if SUMS == "dot":
            # Sums of pull times 1, u, v, u^2, uv, v^2 (u, v from the tile's centre, exact in tf32) as one small product per
            # half of pull, then moved to the splat's own centre.
            u = x - (left + 8.0)
            v = y - (top + 8.0)
            k = tl.arange(0, 16)
            basis = tl.trans(monomials(u, v, k))
            basis = tl.where(k[None, :] < 6, basis, 0.0)
            high = tf32_part(pull)
            moments = tl.dot(high, basis, input_precision="tf32")
            moments = tl.dot(pull - high, basis, moments, input_precision="tf32")
            s0 = tl.sum(tl.where(k[None, :] == 0, moments, 0.0), axis=1)
            su = tl.sum(tl.where(k[None, :] == 1, moments, 0.0), axis=1)
            sv = tl.sum(tl.where(k[None, :] == 2, moments, 0.0), axis=1)
            suu = tl.sum(tl.where(k[None, :] == 3, moments, 0.0), axis=1)
            suv = tl.sum(tl.where(k[None, :] == 4, moments, 0.0), axis=1)
            svv = tl.sum(tl.where(k[None, :] == 5, moments, 0.0), axis=1)
            ox = (left + 8.0) - mx
            oy = (top + 8.0) - my
            sx = su + ox * s0
            sy = sv + oy * s0
            sxx = suu + 2.0 * ox * su + ox * ox * s0
            sxy = suv + ox * sv + oy * su + ox * oy * s0
            syy = svv + 2.0 * oy * sv + oy * oy * s0
        else:
            dx = x[None, :] - mx[:, None]
            dy = y[None, :] - my[:, None]
            s0 = tl.sum(pull, axis=1)
            sx = tl.sum(pull * dx, axis=1)
            sy = tl.sum(pull * dy, axis=1)
            sxx = tl.sum(pull * dx * dx, axis=1)
            sxy = tl.sum(pull * dx * dy, axis=1)
            syy = tl.sum(pull * dy * dy, axis=1)
        tl.atomic_add(target, a * sx + b * sy, mask=listed)
        tl.atomic_add(target + 1, b * sx + c * sy, mask=listed)
        tl.atomic_add(target + 2, -0.5 * sxx, mask=listed)
        tl.atomic_add(target + 3, -sxy, mask=listed)
        tl.atomic_add(target + 4, -0.5 * syy, mask=listed)
        tl.atomic_add(target + 5, s0 / opacity, mask=listed & (opacity > 0.0))
        tl.atomic_add(target + 6, tl.sum(weight * g_red[None, :], axis=1), mask=listed)
        tl.atomic_add(target + 7, tl.sum(weight * g_green[None, :], axis=1), mask=listed)
        tl.atomic_add(target + 8, tl.sum(weight * g_blue[None, :], axis=1), mask=listed)
        if DEPTH:
            tl.atomic_add(target + 9, tl.sum(weight * g_depth[None, :], axis=1), mask=listed)
        if SCORES:
            px = x[None, :] - mx[:, None]
            py = y[None, :] - my[:, None]
            tl.atomic_add(
                target + 10, tl.sum(tl.abs(pull * (a[:, None] * px + b[:, None] * py)), axis=1), mask=listed
            )
            tl.atomic_add(
                target + 11, tl.sum(tl.abs(pull * (b[:, None] * px + c[:, None] * py)), axis=1), mask=listed
            )
            tl.atomic_add(target + 12, tl.sum(weight * error[None, :], axis=1), mask=listed)


def blend_backward(
    records: Tensor,
    bins: Bins,
    made: Blended,
    width: int,
    height: int,
    background: Tensor | None,
    d_color: Tensor,
    *,
    d_alpha: Tensor | None = None,
    d_depth: Tensor | None = None,
    errors: Tensor | None = None,
) -> Tensor:
    """Gradient records [N, 16] (see `record`) of one view; with errors [H, W] the densification sums are filled too."""
    if made.checkpoints is None or made.segment_tile is None:
        raise ValueError(
            "the view was composited without checkpoints; composite it again with them to differentiate it"
        )
    gradient = torch.zeros(records.shape[0], GRADIENT_WIDTH, device=records.device, dtype=torch.float32)
    composite_backward_kernel[(made.segment_tile.shape[0],)](
        records, bins.offsets, bins.ids, background, made.color, made.transmittance, made.depth, made.checkpoints,
        made.first_segment, made.segment_tile, d_color.contiguous(),
        None if d_alpha is None else d_alpha.contiguous(), None if d_depth is None else d_depth.contiguous(), errors, gradient,
        width, height, -(-width // TILE),
        BACKGROUND=background is not None, ALPHA=d_alpha is not None, DEPTH=d_depth is not None,
        SCORES=errors is not None, SEGMENT=SEGMENT,
    )  # fmt: skip
    return gradient
