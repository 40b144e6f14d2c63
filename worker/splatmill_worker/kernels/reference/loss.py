"""L1 plus D-SSIM between a rendering and an 8-bit photo."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812  (the field's own abbreviation)
from torch import Tensor

WINDOW, SIGMA = 11, 1.5  # Wang et al. 2004
C1, C2 = 0.01**2, 0.03**2


class PhotoStats(NamedTuple):
    """The part of SSIM that depends on the photo and its mask alone.

    mean: [H,W,3] windowed mean.
    variance: [H,W,3] windowed variance.
    """

    mean: Tensor
    variance: Tensor


def loss(
    color: Tensor,
    photo: Tensor,
    *,
    dssim_weight: float = 0.2,
    mask: Tensor | None = None,
    stats: PhotoStats | None = None,
) -> Tensor:
    """Return (1 - w) mean|color - photo/255| + w (1 - mean SSIM), means over the used pixels and three channels.

    color [H,W,3]; photo uint8 [H,W,3]; mask uint8 or bool [H,W], nonzero where a pixel is used; stats from
    `photo_stats`. SSIM (Wang et al. 2004) has an 11-tap separable Gaussian window of sigma 1.5 and zero padding. Under
    a mask both images are first set to 0 at unused pixels, which therefore reach neither the value nor the gradient:
    the edge of a mask is treated like the edge of an image. Without a used pixel the loss is 0.
    """
    used = None if mask is None else (mask != 0).to(color.dtype)[..., None]
    target = photo.to(color.dtype) / 255
    count = float(color[..., 0].numel())
    if used is not None:
        # where() in place of a product, so that a NaN at an unused pixel stays out.
        color, target = torch.where(used > 0, color, 0.0), target * used
        count = float(used.sum())
    if count == 0:
        return color.sum() * 0
    l1 = (color - target).abs().sum() / (3 * count)
    if stats is None:
        stats = photo_stats(photo, mask=mask, dtype=color.dtype)
    mu1, mu2 = _window(color), stats.mean
    var1 = _window(color * color) - mu1 * mu1
    covariance = _window(color * target) - mu1 * mu2
    ssim = ((2 * mu1 * mu2 + C1) * (2 * covariance + C2)) / (
        (mu1 * mu1 + mu2 * mu2 + C1) * (var1 + stats.variance + C2)
    )
    total = ssim.sum() if used is None else (ssim * used).sum()
    return (1 - dssim_weight) * l1 + dssim_weight * (1 - total / (3 * count))


def photo_stats(
    photo: Tensor, *, mask: Tensor | None = None, dtype: torch.dtype = torch.float32
) -> PhotoStats:
    """Return the windowed mean and variance of a photo (uint8 [H,W,3]) under a mask, each [H,W,3]."""
    target = photo.to(dtype) / 255
    if mask is not None:
        target = target * (mask != 0).to(dtype)[..., None]
    mean = _window(target)
    return PhotoStats(mean, _window(target * target) - mean * mean)


def _window(image: Tensor) -> Tensor:
    """Apply the 11-tap Gaussian window to an image [H,W,3], with zeros outside."""
    x = torch.arange(WINDOW, dtype=image.dtype, device=image.device) - WINDOW // 2
    taps = torch.exp(-x * x / (2 * SIGMA * SIGMA))
    taps = taps / taps.sum()
    planes = image.permute(2, 0, 1)[:, None]
    planes = F.conv2d(planes, taps.reshape(1, 1, 1, -1), padding=(0, WINDOW // 2))
    planes = F.conv2d(planes, taps.reshape(1, 1, -1, 1), padding=(WINDOW // 2, 0))
    return planes[:, 0].permute(1, 2, 0)
