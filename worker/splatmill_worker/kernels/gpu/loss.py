"""L1 plus D-SSIM against an 8-bit photo, value and gradient in four kernels, and the photo's statistics in two.

The window of SSIM is separable: two kernels apply it to the moments, across and then down, and two to the derivatives.
Its eleven shifted reads hit the first-level cache; between the kernels, three planes per channel go through memory.
Moments are those of the rendering's difference from the photo, and the photo's variance is taken about a centre nearby:
bright, even colours keep the digits of their contrast. The formulas stand at the head of `cpu/training/loss.cpp`.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..reference.loss import C1, C2, SIGMA, WINDOW, PhotoStats
from . import device
from .launch.argument import Bytes, Float, Floats, Int
from .launch.constant import constant
from .launch.tuning import LOSS, SMALLEST_LOSS_BLOCK, autotune
from .transfers.transfer import to_device

REACH = constant(WINDOW // 2)
TAPS = constant(WINDOW)
S1, S2 = constant(C1), constant(C2)
TOTAL_BLOCK = 1024
"""Rows of sums that the one program of `total_kernel` reads at a time."""

# First of the three planes, one per channel, of each windowed moment: of d, d^2 and d y (photo y, rendered y + d). The
# derivatives of SSIM by them, its slopes, have the same places.
D, DD, DY = (constant(3 * number) for number in range(3))
MEAN, VARIANCE = constant(0), constant(3)
"""First of the three planes of what `row_stats_kernel` leaves."""


@triton.jit
def load_photo(photo, mask, place, channel, inside, MASK: tl.constexpr):
    """Values of one channel of the photo, and where they are used: `inside`, and under the mask if any. Elsewhere 0."""
    used = inside
    if MASK:
        used = inside & (tl.load(mask + place, mask=inside, other=0) != 0)
    return tl.load(photo + place * 3 + channel, mask=used, other=0).to(tl.float32) / 255.0, used


@triton.jit
def load_pair(color, photo, mask, place, channel, inside, MASK: tl.constexpr):
    """The rendering's difference from the photo, the photo, and where they are used. Elsewhere both are 0."""
    y, used = load_photo(photo, mask, place, channel, inside, MASK)
    return tl.load(color + place * 3 + channel, mask=used, other=0.0) - y, y, used


@autotune(LOSS, key=["MASK"])
@triton.jit
def across_kernel(
    color: Floats, photo: Bytes, mask: Bytes, taps: Floats, planes: Floats, width: Int, height: Int,
    MASK: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """The moments windowed along rows, planes [3, 3, H, W]."""
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    channel = tl.program_id(1)
    plane = width * height
    here = p < plane
    column = p % width
    by_d = tl.zeros([BLOCK], tl.float32)
    by_dd, by_dy = by_d, by_d
    for k in tl.static_range(TAPS):
        shift = k - REACH
        inside = here & (column + shift >= 0) & (column + shift < width)
        d, y, _ = load_pair(color, photo, mask, p + shift, channel, inside, MASK)
        weighted = tl.load(taps + k) * d
        by_d += weighted
        by_dd += weighted * d
        by_dy += weighted * y
    out = planes + channel * plane + p
    tl.store(out + D * plane, by_d, mask=here)
    tl.store(out + DD * plane, by_dd, mask=here)
    tl.store(out + DY * plane, by_dy, mask=here)


@triton.jit
def down(planes, taps, p, row, here, width, height):
    """The window along columns of one plane, at pixels p."""
    total = tl.zeros_like(p).to(tl.float32)
    for k in tl.static_range(TAPS):
        shift = k - REACH
        inside = here & (row + shift >= 0) & (row + shift < height)
        total += tl.load(taps + k) * tl.load(planes + p + shift * width, mask=inside, other=0.0)
    return total


@autotune(LOSS, key=["MASK"])
@triton.jit
def value_kernel(
    color: Floats, photo: Bytes, mask: Bytes, mean: Floats, variance: Floats, taps: Floats, planes: Floats,
    slopes: Floats, sums: Floats, width: Int, height: Int,
    MASK: tl.constexpr, SLOPES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Per program the sums of |d| and of SSIM; with SLOPES also SSIM's derivatives by the windowed d, d^2 and d y.

    slopes [3, 3, H, W]; sums [programs * 3, 2].
    """
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    channel = tl.program_id(1)
    plane = width * height
    here = p < plane
    row = p // width
    source = planes + channel * plane
    mean_d = down(source + D * plane, taps, p, row, here, width, height)
    # Exactly, a variance is never negative; rounded, it can be, and would let the denominator near zero.
    spread = tl.maximum(down(source + DD * plane, taps, p, row, here, width, height) - mean_d * mean_d, 0.0)
    mu2 = tl.load(mean + p * 3 + channel, mask=here, other=0.0)
    var2 = tl.load(variance + p * 3 + channel, mask=here, other=0.0)
    mu1 = mu2 + mean_d
    covariance = down(source + DY * plane, taps, p, row, here, width, height) - mean_d * mu2
    var1 = tl.maximum(var2 + spread + 2.0 * covariance, 0.0)
    b1, b2 = mu1 * mu1 + mu2 * mu2 + S1, var1 + var2 + S2
    shift, part = mean_d / b1, spread / b2
    light, structure = 1.0 - mean_d * shift, 1.0 - part
    ssim = light * structure
    d, _, used = load_pair(color, photo, mask, p, channel, here, MASK)
    if SLOPES:
        by_square = -ssim / b2
        by_product = 2.0 * light * part / b2
        direct = structure * shift * (1.0 - mu1 * shift)
        by_mean = -2.0 * (mean_d * by_square + direct) - mu2 * by_product
        out = slopes + channel * plane + p
        tl.store(out + D * plane, tl.where(used, by_mean, 0.0), mask=here)
        tl.store(out + DD * plane, tl.where(used, by_square, 0.0), mask=here)
        tl.store(out + DY * plane, tl.where(used, by_product, 0.0), mask=here)
    place = sums + 2 * (tl.program_id(0) * 3 + channel)
    tl.store(place, tl.sum(tl.where(used, tl.abs(d), 0.0), axis=0))
    tl.store(place + 1, tl.sum(tl.where(used, ssim, 0.0), axis=0))


@autotune(LOSS, key=[])
@triton.jit
def down_kernel(planes: Floats, taps: Floats, windowed: Floats, width: Int, height: Int, BLOCK: tl.constexpr):
    """The window along columns of as many planes as the second side of the grid is long."""
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    plane = width * height
    here = p < plane
    source = tl.program_id(1) * plane
    tl.store(
        windowed + source + p, down(planes + source, taps, p, p // width, here, width, height), mask=here
    )


@autotune(LOSS, key=["MASK"])
@triton.jit
def gradient_kernel(
    color: Floats, photo: Bytes, mask: Bytes, taps: Floats, planes: Floats, used_pixels: Floats, d_color: Floats,
    width: Int, height: Int, weight: Float,
    MASK: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """The gradient to the image: the slopes, windowed along rows as well, and the sign of L1; 0 at unused pixels.

    planes holds the slopes windowed along columns; used_pixels [] their number.
    """
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    channel = tl.program_id(1)
    plane = width * height
    here = p < plane
    column = p % width
    by_mean = tl.zeros([BLOCK], tl.float32)
    by_square, by_product = by_mean, by_mean
    for k in tl.static_range(TAPS):
        shift = k - REACH
        tap = tl.load(taps + k)
        inside = here & (column + shift >= 0) & (column + shift < width)
        source = planes + channel * plane + p + shift
        by_mean += tap * tl.load(source + D * plane, mask=inside, other=0.0)
        by_square += tap * tl.load(source + DD * plane, mask=inside, other=0.0)
        by_product += tap * tl.load(source + DY * plane, mask=inside, other=0.0)
    d, y, used = load_pair(color, photo, mask, p, channel, here, MASK)
    share = 1.0 / (3.0 * tl.maximum(tl.load(used_pixels), 1.0))
    slope = by_mean + 2.0 * d * by_square + y * by_product
    sign = tl.where(d > 0.0, 1.0, tl.where(d < 0.0, -1.0, 0.0))
    value = share * ((1.0 - weight) * sign - weight * slope)
    tl.store(d_color + p * 3 + channel, tl.where(used, value, 0.0), mask=here)


@autotune(LOSS, key=["MASK"])
@triton.jit
def row_stats_kernel(
    photo: Bytes, mask: Bytes, taps: Floats, rows: Floats, width: Int, height: Int,
    MASK: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Mean and variance of the window along rows, rows [2, 3, H, W], about the pixel in its middle."""
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    channel = tl.program_id(1)
    plane = width * height
    here = p < plane
    column = p % width
    middle, _ = load_photo(photo, mask, p, channel, here, MASK)
    first = tl.zeros([BLOCK], tl.float32)
    second = first
    for k in tl.static_range(TAPS):
        shift = k - REACH
        inside = here & (column + shift >= 0) & (column + shift < width)
        y, _ = load_photo(photo, mask, p + shift, channel, inside, MASK)
        off = y - middle
        weighted = tl.load(taps + k) * off
        first += weighted
        second += weighted * off
    out = rows + channel * plane + p
    tl.store(out + MEAN * plane, middle + first, mask=here)
    tl.store(out + VARIANCE * plane, second - first * first, mask=here)


@autotune(LOSS, key=[])
@triton.jit
def stats_kernel(
    rows: Floats, taps: Floats, mean: Floats, variance: Floats, width: Int, height: Int, BLOCK: tl.constexpr
):  # fmt: skip
    """Mean and variance [H, W, 3] of the whole window, from those of its rows.

    The variance is the mean of the rows' variances and the variance of their means.
    """
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    channel = tl.program_id(1)
    plane = width * height
    here = p < plane
    row = p // width
    means, variances = rows + (MEAN + channel) * plane, rows + (VARIANCE + channel) * plane
    center = tl.load(means + p, mask=here, other=0.0)
    first = tl.zeros([BLOCK], tl.float32)
    second = first
    for k in tl.static_range(TAPS):
        shift = k - REACH
        inside = here & (row + shift >= 0) & (row + shift < height)
        tap = tl.load(taps + k)
        off = tl.load(means + p + shift * width, mask=inside, other=0.0) - center
        first += tap * off
        second += tap * (off * off + tl.load(variances + p + shift * width, mask=inside, other=0.0))
    tl.store(mean + p * 3 + channel, center + first, mask=here)
    tl.store(variance + p * 3 + channel, tl.maximum(second - first * first, 0.0), mask=here)


@triton.jit
def total_kernel(
    sums: Floats, used_pixels: Floats, losses: Floats, rows: Int, weight: Float, BLOCK: tl.constexpr,
):  # fmt: skip
    """From the programs' sums [rows, 2] to losses [3]: the loss, L1 and SSIM. All are 0 without a used pixel."""
    off = tl.zeros([BLOCK], tl.float32)
    similar = off
    done = 0
    while done < rows:
        i = done + tl.arange(0, BLOCK)
        off += tl.load(sums + 2 * i, mask=i < rows, other=0.0)
        similar += tl.load(sums + 2 * i + 1, mask=i < rows, other=0.0)
        done += BLOCK
    count = tl.load(used_pixels)
    share = 1.0 / (3.0 * tl.maximum(count, 1.0))
    l1 = tl.sum(off, axis=0) * share
    ssim = tl.sum(similar, axis=0) * share
    tl.store(losses, (1.0 - weight) * l1 + weight * (tl.where(count > 0.0, 1.0, 0.0) - ssim))
    tl.store(losses + 1, l1)
    tl.store(losses + 2, ssim)


@lru_cache(maxsize=4)
def window_taps(where: torch.device) -> Tensor:
    """Return the taps [11] of the window, kept per device."""
    x = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
    taps = torch.exp(-x * x / (2 * SIGMA * SIGMA))
    return to_device((taps / taps.sum()).float(), where)


def loss_and_gradient(
    color: Tensor,
    photo: Tensor,
    *,
    dssim_weight: float,
    mask: Tensor | None,
    stats: PhotoStats | None,
    count: Tensor | None = None,
    gradient: bool = True,
) -> tuple[Tensor, Tensor | None]:
    """Return the loss, its L1 and its SSIM as one tensor [3], and the gradient to color [H, W, 3] (None unless asked).

    Arguments as in `reference.loss`; count float32 [], the number of pixels used, is computed where it is not given.
    Nothing waits for the device. Raises ValueError for an image too large for 32-bit offsets.
    """
    height, width = color.shape[:2]
    pixels = height * width
    if pixels * 15 >= 2**31:
        raise ValueError(
            f"The image is {width}x{height}; offsets into its planes have 32 bits, enough for 143 megapixels."
        )
    like: dict[str, Any] = {"device": color.device, "dtype": torch.float32}
    if mask is not None:
        mask = mask.to(torch.uint8).contiguous()
    if count is None:
        count = (
            torch.full((), float(pixels), **like)
            if mask is None
            else torch.count_nonzero(mask).to(torch.float32)
        )
    if stats is None:
        stats = photo_stats(photo, mask=mask)
    taps = window_taps(color.device)
    planes = torch.empty(3, 3, height, width, **like)
    slopes = torch.empty(3, 3, height, width, **like) if gradient else None
    sums = torch.zeros(triton.cdiv(pixels, SMALLEST_LOSS_BLOCK) * 3, 2, **like)
    masked = mask is not None

    def grid(meta: dict[str, Any]) -> tuple[int, int]:
        return triton.cdiv(pixels, meta["BLOCK"]), 3

    across_kernel[grid](color, photo, mask, taps, planes, width, height, MASK=masked)
    value_kernel[grid](
        color, photo, mask, stats.mean.contiguous(), stats.variance.contiguous(), taps, planes, slopes, sums,
        width, height, MASK=masked, SLOPES=gradient,
    )  # fmt: skip
    losses = torch.empty(3, **like)
    total_kernel[(1,)](sums, count, losses, sums.shape[0], dssim_weight, BLOCK=TOTAL_BLOCK)
    if slopes is None:
        return losses, None
    down_kernel[lambda meta: (triton.cdiv(pixels, meta["BLOCK"]), 9)](slopes, taps, planes, width, height)
    d_color = torch.empty_like(color)
    gradient_kernel[grid](
        color, photo, mask, taps, planes, count, d_color, width, height, dssim_weight, MASK=masked
    )
    return losses, d_color


class _Loss(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        color: Tensor,
        photo: Tensor,
        dssim_weight: float,
        mask: Tensor | None,
        stats: PhotoStats | None,
    ) -> Tensor:
        losses, d_color = loss_and_gradient(
            color.contiguous(), photo.contiguous(), dssim_weight=dssim_weight, mask=mask, stats=stats,
            gradient=ctx.needs_input_grad[0],
        )  # fmt: skip
        ctx.save_for_backward(d_color)
        return losses[0].clone()  # autograd takes no view

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_value: Tensor) -> tuple[Tensor | None, ...]:
        (d_color,) = ctx.saved_tensors
        return d_value * d_color, None, None, None, None


def loss(
    color: Tensor,
    photo: Tensor,
    *,
    dssim_weight: float = 0.2,
    mask: Tensor | None = None,
    stats: PhotoStats | None = None,
) -> Tensor:
    """(1 - w) mean |color - photo/255| + w (1 - mean SSIM), differentiable in color, as `reference.loss` defines it."""
    device.require(color)
    value: Tensor = _Loss.apply(color, photo, dssim_weight, mask, stats)
    return value


@torch.no_grad()
def photo_stats(photo: Tensor, *, mask: Tensor | None = None) -> PhotoStats:
    """Return the windowed mean and variance of a photo (uint8 [H,W,3]) under a mask, each [H,W,3]: 24 bytes a pixel."""
    device.require(photo)
    height, width = photo.shape[:2]
    photo = photo.contiguous()
    mask = None if mask is None else mask.to(torch.uint8).contiguous()
    taps = window_taps(photo.device)
    rows = torch.empty(2, 3, height, width, device=photo.device)
    mean = torch.empty(height, width, 3, device=photo.device)
    variance = torch.empty_like(mean)

    def grid(meta: dict[str, Any]) -> tuple[int, int]:
        return triton.cdiv(height * width, meta["BLOCK"]), 3

    row_stats_kernel[grid](photo, mask, taps, rows, width, height, MASK=mask is not None)
    stats_kernel[grid](rows, taps, mean, variance, width, height)
    return PhotoStats(mean, variance)
