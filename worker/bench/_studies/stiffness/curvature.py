"""The Hessian of the training loss in the metric of Adam, by its products with vectors.

Adam with momentum moves x by -P^-1 m, where P = (sqrt(v_hat) + eps) / rate is diagonal. In the coordinates z = P^1/2
x the Hessian is A = P^-1/2 H P^-1/2. On a quadratic, steps with the exact gradient are stable while the largest
eigenvalue of A is below (2 + 2 beta1) / (1 - beta1) = 38 (Cohen et al. 2022, *Adaptive Gradient Methods at the Edge
of Stability*; the learning rate is part of P here).

The loss is 0.8 L1 + 0.2 D-SSIM. |r| has no curvature but at r = 0, where it has all of it: what a step sees is the
share of residuals that it brings across 0. |r| is therefore replaced by sqrt(r^2 + d^2), where d is one grey level of
the 8-bit photo (`GREY`): below that, residuals are rounding of the photo. The thresholds of the renderer (alpha
1/255, the end of a pixel, a colour of 0) stay as they are; products by differences over a finite distance count what
crosses them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from splatmill_worker.kernels.cpu.loss import PhotoStats, loss, photo_stats
from splatmill_worker.kernels.cpu.step import Step
from splatmill_worker.kernels.records import BETA1, EPS, GROUPS, PARAMETERS, Rates
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.train.renderer import fixed_background
from splatmill_worker.splat.views import TrainingView

GREY = 1.0 / 255.0
"""Width over which |r| is rounded off, in units of colour."""

DSSIM = 0.2
"""Weight of 1 - SSIM in the loss."""

LIMIT = (2.0 + 2.0 * BETA1) / (1.0 - BETA1)
"""Largest eigenvalue at which steps with the exact gradient are stable: 38."""

COLUMNS = {
    "means": slice(0, 3),
    "log_scales": slice(3, 6),
    "quats": slice(6, 10),
    "logit_opacities": slice(10, 11),
    "sh_dc": slice(11, 14),
    "sh_rest": slice(14, 59),
}
"""The columns of each group of `Rates` in parameters [N, 59]."""


@dataclass(frozen=True)
class Shot:
    """A photo that the loss is taken on, over the background of the step."""

    viewmat: Tensor
    K: Tensor
    photo: Tensor
    mask: Tensor | None
    background: Tensor
    stats: PhotoStats


def shots(views: Sequence[TrainingView], plan: Plan, reduction: int, seed: int = 0) -> list[Shot]:
    """The photos at a reduction; where the plan's background is random, each has one that is drawn once."""
    random = torch.Generator().manual_seed(seed)
    made = []
    for view in views:
        target = view.reduced(reduction)
        background = (
            torch.rand(3, generator=random) if plan.background == "random" else fixed_background(plan)
        )
        photo = target.over(background)
        made.append(
            Shot(
                target.viewmat, target.K, photo, target.mask, background, photo_stats(photo, mask=target.mask)
            )
        )
    return made


def joined(parameters: dict[str, Tensor]) -> Tensor:
    """The five groups side by side, float64 [N, 59]."""
    count = len(parameters["means"])
    return torch.cat([parameters[name].reshape(count, -1) for name in GROUPS], dim=1).double()


def parted(x: Tensor, dtype: torch.dtype = torch.float32) -> dict[str, Tensor]:
    """The five groups of [N, 59] by name."""
    parts = dict(zip(GROUPS, torch.split(x.to(dtype), list(GROUPS.values()), dim=1), strict=True))
    return parts | {
        "logit_opacities": parts["logit_opacities"][:, 0],
        "sh": parts["sh"].reshape(len(x), -1, 3),
    }


class Objective:
    """The mean over photos of the training loss with |r| rounded off, and its gradient by the fused CPU step.

    width: d of sqrt(r^2 + d^2), in units of colour; 0: |r| itself.
    """

    def __init__(
        self, shots: Sequence[Shot], *, degree: int, antialias: bool = False, width: float = GREY
    ) -> None:
        self.shots, self.degree, self.antialias, self.width = list(shots), degree, antialias, width

    def gradient(self, x: Tensor) -> Tensor:
        """The gradient, float64 [N, 59], at parameters x [N, 59], which are rounded to float32."""
        step = _step(x)
        total = torch.zeros_like(x)
        for shot in self.shots:
            color, residual = self._rendered(step, shot)
            image = color.clone().requires_grad_()
            (of_ssim,) = torch.autograd.grad(
                loss(image, shot.photo, dssim_weight=1.0, stats=shot.stats), image
            )
            slope = (
                residual.sign()
                if self.width == 0
                else residual / torch.sqrt(residual * residual + self.width**2)
            )
            by_color = (1.0 - DSSIM) / (3.0 * shot.stats.weight) * slope + DSSIM * of_ssim
            total += joined(step.gradients(by_color))
        return total / len(self.shots)

    def value(self, x: Tensor) -> float:
        """The loss at parameters x [N, 59]."""
        step = _step(x)
        total = 0.0
        for shot in self.shots:
            color, residual = self._rendered(step, shot)
            absolute = (
                torch.sqrt(residual.double() ** 2 + self.width**2).sum() - self.width * residual.numel()
            )
            of_ssim = float(loss(color, shot.photo, dssim_weight=1.0, stats=shot.stats))
            total += (1.0 - DSSIM) / (3.0 * shot.stats.weight) * float(absolute) + DSSIM * of_ssim
        return total / len(self.shots)

    def _rendered(self, step: Step, shot: Shot) -> tuple[Tensor, Tensor]:
        """The colour [H, W, 3], and its difference to the photo, 0 at pixels that do not count."""
        height, width = shot.photo.shape[:2]
        color, _, _ = step.forward(
            shot.viewmat, shot.K, width, height,
            degree=self.degree, background=shot.background, antialias=self.antialias,
        )  # fmt: skip
        residual = color - shot.photo.float() / 255.0
        return color, residual if shot.mask is None else residual * shot.mask[..., None]


def _step(x: Tensor) -> Step:
    groups = parted(x)
    return Step(
        groups["means"], groups["log_scales"], groups["quats"], groups["logit_opacities"], groups["sh"]
    )


@dataclass(frozen=True)
class Metric:
    """Adam's metric at one step of a training.

    root: P^-1/2, float64 [N, 59]; 0 for values that have had no gradient yet, which are left out.
    rates: learning rates [59].
    """

    root: Tensor
    rates: Tensor

    @staticmethod
    def of(exp_avg_sq: Tensor, rates: Rates, step: int) -> Metric:
        """The metric after `step` steps that left the second moments [N, 59]."""
        square = exp_avg_sq.double() / (1.0 - rates.beta2**step)
        row = torch.tensor(rates.rows(), dtype=torch.float64)
        root = torch.where(square > 0, torch.sqrt(row / (torch.sqrt(square) + EPS)), 0.0)
        return Metric(root, row)

    def within(self, group: str) -> Metric:
        """The metric with all groups but one left out."""
        kept = torch.zeros(PARAMETERS, dtype=torch.float64)
        kept[COLUMNS[group]] = 1.0
        return Metric(self.root * kept, self.rates)

    def reach(self, u: Tensor) -> float:
        """The factor on u [N, 59] at which the value that moves most, in its own rate, moves by one rate: the length of
        a step of Adam in this direction."""
        return 1.0 / float((self.root * u / self.rates.clamp_min(1e-300)).abs().max())


def product(
    gradient: Callable[[Tensor], Tensor], x: Tensor, metric: Metric, share: float = 1.0
) -> Callable[[Tensor], Tensor]:
    """u -> A u by a central difference of the gradient over `share` of a step to both sides.

    Over the distance of a step, the difference is the curvature that the step meets, whether the loss is smooth there
    or not.
    """

    def apply(u: Tensor) -> Tensor:
        h = share * metric.reach(u)
        moved = h * metric.root * u
        change: Tensor = metric.root * (gradient(x + moved) - gradient(x - moved)) / (2.0 * h)
        return change

    return apply


def start(metric: Metric, seed: int = 0) -> Tensor:
    """A random vector [N, 59] over the values that the metric holds."""
    random = torch.Generator().manual_seed(seed)
    drawn = torch.randn(metric.root.shape, generator=random, dtype=torch.float64)
    return drawn * (metric.root > 0)
