"""How close rendered views are to photos: PSNR and SSIM."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.splat.views import Target, TrainingView

Renderer = Callable[[Target, Tensor], Tensor]
"""Renders colour [H, W, 3] of a target's camera over a background [3]."""


@dataclass(frozen=True)
class ViewScore:
    """Error of one rendered view against its photo, over the pixels that count.

    name: of the photo.
    mse: mean squared error of colours in 0 to 1.
    psnr: dB.
    ssim: structural similarity (Wang et al. 2004), 1 for identical images.
    """

    name: str
    mse: float
    psnr: float
    ssim: float


@dataclass(frozen=True)
class Score:
    """Scores of views and their means, as the field reports them: the mean of PSNRs, not the PSNR of the mean error."""

    views: tuple[ViewScore, ...]

    @property
    def psnr(self) -> float:
        """Mean over the views, dB."""
        return sum(view.psnr for view in self.views) / len(self.views)

    @property
    def ssim(self) -> float:
        """Mean over the views."""
        return sum(view.ssim for view in self.views) / len(self.views)

    @property
    def mse(self) -> float:
        """Mean over the views, of colours in 0 to 1."""
        return sum(view.mse for view in self.views) / len(self.views)


def evaluate(render: Renderer, views: Sequence[TrainingView], background: Tensor) -> Score:
    """Score of every view at full training resolution, over the RGB `background` [3] where photos are transparent."""
    scores = []
    for view in views:
        target = view.full
        scores.append(compare(view.name, render(target, background), target.over(background), target.mask))
    return Score(tuple(scores))


def benchmark_background(views: Sequence[TrainingView]) -> Tensor:
    """RGB [3] behind evaluated views in published results: white where any photo is transparent, black otherwise."""
    return torch.full((3,), float(any(view.full.alpha is not None for view in views)))


def compare(name: str, color: Tensor, photo: Tensor, mask: Tensor | None = None) -> ViewScore:
    """Score of a rendered image [H, W, 3] against a photo uint8 [H, W, 3], over the pixels where `mask` [H, W] is true.

    Windows of SSIM leave out masked pixels too: the edge of a mask counts as an edge of the image, as in the loss.
    """
    image = color.detach().float().clamp(0.0, 1.0)
    truth = photo.to(image.device).float() / 255.0
    squares = (image - truth).square().mean(dim=2)
    counted = mask.to(image.device) if mask is not None and bool(mask.any()) else None
    if counted is not None:
        squares = squares[counted]
    # The kernels' SSIM, which the loss is made of: a curve is evaluated every few seconds, and plain torch is too slow.
    similarity = 1.0 - float(
        ops.loss(image, photo.to(image.device).contiguous(), mask=counted, dssim_weight=1.0)
    )
    mse = float(squares.double().mean())
    return ViewScore(name, mse, psnr(mse), similarity)


def psnr(mse: float) -> float:
    """PSNR in dB of a mean squared error of colours in 0 to 1; 100 dB for images that are identical."""
    return 100.0 if mse < 1e-10 else -10.0 * math.log10(mse)
