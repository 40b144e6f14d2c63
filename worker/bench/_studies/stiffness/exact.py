"""The same products in float64, from the reference by differentiating twice: what the fast ones are compared with."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.reference.loss import loss

from .curvature import DSSIM, Metric, Objective, parted


def value(objective: Objective, x: Tensor) -> Tensor:
    """The objective at x [N, 59] float64, differentiable twice."""
    groups = parted(x, torch.float64)
    terms = []
    for shot in objective.shots:
        height, width = shot.photo.shape[:2]
        splats = ops.project(
            groups["means"], groups["log_scales"], groups["quats"], groups["logit_opacities"], groups["sh"],
            shot.viewmat.double(), shot.K.double(), width, height,
            degree=objective.degree, antialias=objective.antialias, backend="reference",
        )  # fmt: skip
        bins = ops.bin(splats, width, height, backend="reference")
        color, _, _ = ops.composite(
            splats, bins, width, height, background=shot.background.double(), backend="reference"
        )
        residual = color - shot.photo.double() / 255.0
        if shot.mask is not None:
            residual = residual * shot.mask[..., None]
        absolute = torch.sqrt(residual * residual + objective.width**2).sum()
        of_ssim = loss(color, shot.photo, dssim_weight=1.0, mask=shot.mask)
        terms.append((1.0 - DSSIM) / (3.0 * shot.stats.weight) * absolute + DSSIM * of_ssim)
    return torch.stack(terms).mean()


def gradient(objective: Objective, x: Tensor) -> Tensor:
    """The gradient [N, 59] in float64."""
    leaf = x.detach().clone().requires_grad_()
    (slope,) = torch.autograd.grad(value(objective, leaf), leaf)
    return slope


def product(objective: Objective, x: Tensor, metric: Metric) -> Callable[[Tensor], Tensor]:
    """u -> A u by differentiating twice. What jumps at the renderer's thresholds counts as constant."""
    leaf = x.detach().clone().requires_grad_()
    (slope,) = torch.autograd.grad(value(objective, leaf), leaf, create_graph=True)

    def apply(u: Tensor) -> Tensor:
        (second,) = torch.autograd.grad((slope * (metric.root * u)).sum(), leaf, retain_graph=True)
        return metric.root * second

    return apply
