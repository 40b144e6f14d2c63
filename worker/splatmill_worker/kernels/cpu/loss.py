"""loss on the CPU: one sweep over the image gives the value and the gradient."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from splatmill_worker.kernels import cpu
from splatmill_worker.kernels.records import TILE

STATISTICS_PER_PIXEL = 28
"""Bytes of the statistics of a photo, for each of its pixels."""


class PhotoStats(NamedTuple):
    """A photo and its part of SSIM, in planes as the engine reads them; `photo_stats` makes it.

    pixels: uint8 [3, height, stride], 0 where a pixel is not used; the stride is the width in whole tiles.
    used: uint8 [height, stride], 1 where a pixel is used.
    mean: float32 [3, height, stride], windowed mean.
    variance: float32 [3, height, stride], windowed variance.
    width: of the photo, pixels.
    weight: number of used pixels.
    """

    pixels: Tensor
    used: Tensor
    mean: Tensor
    variance: Tensor
    width: int
    weight: float


def photo_stats(photo: Tensor, *, mask: Tensor | None = None) -> PhotoStats:
    """Return the planes and SSIM statistics of a photo (uint8 [H,W,3]) under a mask ([H,W], nonzero where used).

    They take STATISTICS_PER_PIXEL. The mask is uint8 or bool.
    """
    height, width = photo.shape[:2]
    stride = whole_tiles(width)
    pixels = torch.empty(3, height, stride, dtype=torch.uint8)
    used = torch.empty(height, stride, dtype=torch.uint8)
    mean, variance = torch.empty(3, height, stride), torch.empty(3, height, stride)
    flat_mask = None if mask is None else mask.contiguous().view(torch.uint8)
    count = cpu.engine.photo_stats(photo.contiguous(), flat_mask, pixels, used, mean, variance)
    return PhotoStats(pixels, used, mean, variance, width, count)


def loss(
    color: Tensor,
    photo: Tensor,
    *,
    dssim_weight: float = 0.2,
    mask: Tensor | None = None,
    stats: PhotoStats | None = None,
) -> Tensor:
    """Return (1 - w) mean|color - photo/255| + w (1 - mean SSIM), differentiable in color, as `reference.loss` does.

    stats, from `photo_stats` of the same photo and mask, saves a third of the time.
    """
    if stats is None:
        stats = photo_stats(photo, mask=mask)
    value: Tensor = _Loss.apply(color, stats, dssim_weight)  # type: ignore[no-untyped-call]  # torch leaves it untyped
    return value


class _Loss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, color: Tensor, stats: PhotoStats, dssim_weight: float) -> Tensor:
        planes = to_planes(color)
        gradient = torch.empty_like(planes)
        height, width = color.shape[:2]
        l1, ssim = cpu.engine.loss(
            planes,
            stats.pixels,
            stats.used,
            stats.mean,
            stats.variance,
            width,
            height,
            stats.weight,
            dssim_weight,
            gradient,
        )
        ctx.save_for_backward(gradient[:, :height, :width].permute(1, 2, 0))
        return color.new_tensor((1 - dssim_weight) * l1 + dssim_weight * (1 - ssim))

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor, None, None]:
        (gradient,) = ctx.saved_tensors
        return gradient * slopes[0], None, None


def to_planes(image: Tensor) -> Tensor:
    """Return an image [H,W,3] as planes [3, rows, columns], padded with zeros to whole tiles."""
    height, width = image.shape[:2]
    planes = image.new_zeros(3, whole_tiles(height), whole_tiles(width))
    planes[:, :height, :width] = image.detach().permute(2, 0, 1)
    return planes


def whole_tiles(pixels: int) -> int:
    """Return a side in pixels rounded up to whole tiles."""
    return -(-pixels // TILE) * TILE
