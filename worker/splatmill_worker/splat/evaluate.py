"""How near rendered views are to photos that were not trained on: PSNR and SSIM."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.reference.loss import C1, C2, SIGMA, WINDOW
from splatmill_worker.splat.views import Target, TrainingView

Renderer = Callable[[Target, Tensor], Tensor]
"""Renders colour [H, W, 3] of a target's camera over a background [3]."""


@dataclass(frozen=True)
class ViewScore:
    """Error of one view: mean squared error of values in 0..1, PSNR in dB, SSIM (Wang et al. 2004)."""

    name: str
    mse: float
    psnr: float
    ssim: float


@dataclass(frozen=True)
class Score:
    """Means over views, as the field reports them: the mean of PSNRs, not the PSNR of the mean error."""

    views: tuple[ViewScore, ...]

    @property
    def psnr(self) -> float:
        return sum(view.psnr for view in self.views) / len(self.views)

    @property
    def ssim(self) -> float:
        return sum(view.ssim for view in self.views) / len(self.views)

    @property
    def mse(self) -> float:
        return sum(view.mse for view in self.views) / len(self.views)


def evaluate(render: Renderer, views: Sequence[TrainingView], background: Tensor) -> Score:
    """Score of every view at full training resolution, over `background` [3] where photos are transparent."""
    scores = []
    for view in views:
        target = view.full
        scores.append(compare(view.name, render(target, background), target.over(background), target.mask))
    return Score(tuple(scores))


def benchmark_background(views: Sequence[TrainingView]) -> Tensor:
    """RGB [3] behind evaluated views in published results: white where any photo is transparent, black otherwise."""
    return torch.full((3,), float(any(view.full.alpha is not None for view in views)))


def compare(name: str, color: Tensor, photo: Tensor, mask: Tensor | None = None) -> ViewScore:
    """Score of a rendered image [H, W, 3] against a photo uint8 [H, W, 3]; only `mask` [H, W] pixels count.

    What is masked reaches no window of SSIM either: the edge of a mask is one of the image, as in the loss.
    """
    image = color.detach().float().clamp(0.0, 1.0)
    truth = photo.to(image.device).float() / 255.0
    squares = (image - truth).square().mean(dim=2)
    counted = mask.to(image.device) if mask is not None and bool(mask.any()) else None
    if counted is not None:
        squares = squares[counted]
    # The kernel's value of `ssim_map`, many times as fast: curves are measured every few seconds.
    similarity = 1.0 - float(
        ops.loss(image, photo.to(image.device).contiguous(), mask=counted, dssim_weight=1.0)
    )
    mse = float(squares.double().mean())
    return ViewScore(name, mse, psnr(mse), similarity)


def psnr(mse: float) -> float:
    """dB of a mean squared error of values in 0..1; identical images are reported as 100 dB."""
    return 100.0 if mse < 1e-10 else -10.0 * math.log10(mse)


def ssim_map(image: Tensor, truth: Tensor) -> Tensor:
    """SSIM per pixel and channel [H, W, 3]: an 11-tap Gaussian window of sigma 1.5, zeros outside the image."""
    a, b = image.permute(2, 0, 1), truth.permute(2, 0, 1)
    maps = torch.cat([a, b, a * a, b * b, a * b])
    mean_a, mean_b, aa, bb, ab = _blurred(maps).chunk(5)
    variance_a, variance_b, covariance = aa - mean_a**2, bb - mean_b**2, ab - mean_a * mean_b
    top = (2 * mean_a * mean_b + C1) * (2 * covariance + C2)
    bottom = (mean_a**2 + mean_b**2 + C1) * (variance_a + variance_b + C2)
    similar: Tensor = top / bottom
    return similar.permute(1, 2, 0)


def _blurred(planes: Tensor) -> Tensor:
    """Planes [C, H, W] under the window, as two banded matrix products (far faster than a depthwise convolution)."""
    height, width = planes.shape[1:]
    return _band(height, planes) @ planes @ _band(width, planes)


def _band(size: int, like: Tensor) -> Tensor:
    """The symmetric matrix [size, size] that applies the window along one axis, with zeros outside."""
    place = torch.arange(size, device=like.device)
    distance = place[:, None] - place[None, :]
    reach = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
    total = float(torch.exp(-reach.square() / (2 * SIGMA * SIGMA)).sum())
    weight = torch.exp(-distance.double().square() / (2 * SIGMA * SIGMA)) / total
    return torch.where(distance.abs() <= WINDOW // 2, weight, torch.zeros_like(weight)).to(like.dtype)
