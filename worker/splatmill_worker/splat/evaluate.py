"""How close rendered views are to photos: PSNR, PSNR after a fit of the colours, SSIM and, where asked for, LPIPS."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.splat.color_fit import color_fitted
from splatmill_worker.splat.lpips import LEAST_SIDE, Distances

if TYPE_CHECKING:  # the renderer compares pictures without what reads photos
    from splatmill_worker.splat.views import Target, TrainingView

Renderer = Callable[["Target", Tensor], Tensor]
"""Renders colour [H, W, 3] of a target's camera over a background [3]."""


@dataclass(frozen=True)
class ViewScore:
    """Error of one rendered view against its photo, over the pixels that count.

    name: of the photo.
    mse: mean squared error of colours in 0 to 1.
    psnr: dB.
    ssim: structural similarity (Wang et al. 2004), 1 for identical images.
    psnr_color_fitted: dB, after the affine map of the rendered colours that fits the photo best. How far it lies above
        `psnr` is what exposure and white balance cost; it uses the photo, and is no score to compare methods by.
    lpips_vgg, lpips_alex: LPIPS by VGG-16 and by AlexNet, 0 for identical images; None where it was not computed.
    """

    name: str
    mse: float
    psnr: float
    ssim: float
    psnr_color_fitted: float
    lpips_vgg: float | None = None
    lpips_alex: float | None = None


@dataclass(frozen=True)
class Score:
    """Scores of views and their means, as the field reports them: the mean of PSNRs, not the PSNR of the mean error."""

    views: tuple[ViewScore, ...]

    @property
    def psnr(self) -> float:
        """Mean over the views, dB."""
        return sum(view.psnr for view in self.views) / len(self.views)

    @property
    def psnr_color_fitted(self) -> float:
        """Mean over the views of the PSNR after the fit of each view's colours, dB."""
        return sum(view.psnr_color_fitted for view in self.views) / len(self.views)

    @property
    def ssim(self) -> float:
        """Mean over the views."""
        return sum(view.ssim for view in self.views) / len(self.views)

    @property
    def mse(self) -> float:
        """Mean over the views, of colours in 0 to 1."""
        return sum(view.mse for view in self.views) / len(self.views)

    @property
    def lpips_vgg(self) -> float | None:
        """Mean over the views; None where one has none."""
        return _mean([view.lpips_vgg for view in self.views])

    @property
    def lpips_alex(self) -> float | None:
        """Mean over the views; None where one has none."""
        return _mean([view.lpips_alex for view in self.views])


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if len(known) == len(values) else None


def evaluate(
    render: Renderer,
    views: Sequence[TrainingView],
    background: Tensor,
    distances: Distances | None = None,
    scored: Callable[[], None] = lambda: None,
) -> Score:
    """Score of every view at full training resolution, over the RGB `background` [3] where photos are transparent.

    distances: LPIPS is computed with them, but not of photos with a mask or with a side below LEAST_SIDE.
    scored: called after each view.
    """
    scores = []
    for view in views:
        target = view.full
        shown, photo = render(target, background), target.over(background)
        score = compare(view.name, shown, photo, target.mask)
        if distances is not None and target.mask is None and min(photo.shape[:2]) >= LEAST_SIDE:
            pictures = shown.detach().float().clamp(0.0, 1.0), photo.to(shown.device).float() / 255.0
            vgg, alex = (distance(*pictures) for distance in distances)
            score = replace(score, lpips_vgg=vgg, lpips_alex=alex)
        scores.append(score)
        scored()
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
    counted = mask.to(image.device) if mask is not None and bool(mask.any()) else None
    shown = image.reshape(-1, 3) if counted is None else image[counted]
    target = truth.reshape(-1, 3) if counted is None else truth[counted]
    # The kernels' SSIM, which the loss is made of: a curve is evaluated every few seconds, and plain torch is too slow.
    similarity = 1.0 - float(
        ops.loss(image, photo.to(image.device).contiguous(), mask=counted, dssim_weight=1.0)
    )
    mse = _mse(shown, target)
    fitted = _mse(color_fitted(shown, target), target)
    return ViewScore(name, mse, psnr(mse), similarity, psnr(fitted))


def _mse(image: Tensor, truth: Tensor) -> float:
    return float((image - truth).square().mean(dim=1).double().mean())


def psnr(mse: float) -> float:
    """PSNR in dB of a mean squared error of colours in 0 to 1; 100 dB for images that are identical."""
    return 100.0 if mse < 1e-10 else -10.0 * math.log10(mse)
