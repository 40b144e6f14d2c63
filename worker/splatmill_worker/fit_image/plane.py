"""One picture as a flat scene: Gaussians in a plane before one camera, fitted from coarse to fine.

Loss, gradients and optimiser are those of training. Depth, orientation out of the plane and SH above degree 0, which
only several views determine, are not optimised. The Gaussians are blended front to back, as every viewer of Gaussian
splats does it, and not summed as in GaussianImage (Zhang et al. 2024), so that any viewer shows the picture.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from splatmill_worker.errors import FailureName, TrainingFailed
from splatmill_worker.fit_image.gabor import FittedWaves, projected_by
from splatmill_worker.kernels.records import Rates
from splatmill_worker.scene import Camera
from splatmill_worker.splat.engine.cpu import CpuEngine
from splatmill_worker.splat.engine.open import gaussians_of
from splatmill_worker.splat.evaluate import ViewScore, compare
from splatmill_worker.splat.gaussians import SH_C0, Gaussians
from splatmill_worker.splat.plan.budget import Budget, Clock
from splatmill_worker.splat.train.density.rows import Rows
from splatmill_worker.splat.views import Target, TrainingView

THICKNESS = 0.05
"""Depth of the slab that holds the Gaussians, over its distance. No two Gaussians share a depth, so that every viewer
blends them in the same order."""

FLAT = 1e-5
"""Standard deviation of a Gaussian across the slab, over its distance: far below a pixel, and not zero, because viewers
divide by it."""

FIRST_SHARE = 0.1
"""Share of the Gaussians that are there at the start; the others are added where the error is large."""

GROWN_AT = (0.06, 0.12, 0.18, 0.25, 0.32, 0.4, 0.48)
"""Shares of the budget at which Gaussians are added, the same number each time."""

REDUCTIONS = ((0.0, 4), (0.04, 2), (0.12, 1))
"""(share of the budget, factor by which the picture is reduced from then on)."""

SMALLEST = 48
"""Least pixels on the shorter side of a reduced picture."""

WIDTH = 0.25
"""Standard deviation of a new Gaussian over the radius of a disc that has its share of the picture's area."""

NARROWEST = 0.4
"""Least standard deviation of a new Gaussian, pixels. Rendering adds a dilation of 0.55 pixels."""

FIRST_OPACITY = 0.7
"""Opacity of a new Gaussian."""

FAINT = 0.01
"""Opacity at or below which a Gaussian is removed when others are added."""

EVALUATED_AT = (0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)


class PlaneRates(Rates):
    """Rates that keep Gaussians in their plane: depth, thickness and the rotations out of the plane do not change."""

    FIXED = (2, 5, 7, 8)  # z; scale along z; quaternion x and y

    def rows(self) -> list[float]:
        """The rate of each of a Gaussian's 59 parameters."""
        return [0.0 if i in self.FIXED else rate for i, rate in enumerate(super().rows())]


@dataclass(frozen=True)
class FitPoint:
    """One evaluation during a fit.

    seconds: time of the fit so far; evaluations and frames are not counted.
    step: optimisation steps so far.
    gaussians: how many there were.
    score: error against the picture at full size.
    """

    seconds: float
    step: int
    gaussians: int
    score: ViewScore


def camera_before(width: int, height: int) -> Camera:
    """The camera at the origin, in front of a picture of `width` x `height` pixels with a longer side of 1, 1 away."""
    focal = float(max(width, height))
    return Camera(width, height, focal, focal, width / 2, height / 2, np.eye(4))


def fit(
    view: TrainingView,
    limit: int,
    budget: Budget,
    *,
    seed: int = 0,
    gabor: FittedWaves | None = None,
    evaluated: Callable[[FitPoint], None] = lambda _: None,
    frames_at: tuple[float, ...] = (),
    frame: Callable[[Tensor], None] = lambda _: None,
) -> tuple[Gaussians, list[FitPoint]]:
    """Fit at most `limit` Gaussians to `view`, whose camera is `camera_before`; returns them and the evaluations.

    gabor: fitted along, where given: Gaussians get waves as soon as the picture has its full size.
    evaluated: gets each evaluation.
    frames_at: shares of the budget at which `frame` gets a rendering [H, W, 3].

    The picture is fitted over random backgrounds, so that the scene becomes transparent where the photo is, and nowhere
    else. Raises TrainingFailed where the loss is not finite.
    """
    run = _Fit(view, limit, budget, torch.Generator().manual_seed(seed), gabor)
    curve: list[FitPoint] = []
    due = list(EVALUATED_AT)
    frames_due = list(frames_at)
    progress = 0.0
    while progress < 1.0:
        run.advance()
        progress = run.progress
        if due[0] <= progress or (frames_due and frames_due[0] <= progress):
            with run.clock.stopped():
                point, color = run.evaluate()
                if due[0] <= progress:
                    due = [share for share in due if share > progress]
                    curve.append(point)
                    evaluated(point)
                if frames_due and frames_due[0] <= progress:
                    frames_due = [share for share in frames_due if share > progress]
                    frame(color)
    return gaussians_of(run.engine).padded(0), curve


class _Fit:
    """A fit in progress: the Gaussians, their optimiser, the clock and the random numbers."""

    def __init__(
        self,
        view: TrainingView,
        limit: int,
        budget: Budget,
        random: torch.Generator,
        gabor: FittedWaves | None,
    ) -> None:
        self.view, self.limit, self.budget, self.random, self.gabor = view, limit, budget, random, gabor
        full = view.full
        self.pixel = 1.0 / full.camera.fx
        first = max(1, round(FIRST_SHARE * limit))
        self.engine = CpuEngine(self._stacked(self._placed(_detail(full), first)))
        self.engine.keep_scores = False
        if gabor is not None:
            gabor.follow(torch.ones(self.engine.count, dtype=torch.bool), 0)
        self.step = 0
        self.growth_due = list(GROWN_AT)
        self.clock = Clock()

    @property
    def progress(self) -> float:
        return self.budget.progress(self.step, self.clock.seconds)

    def advance(self) -> None:
        """Take one step, and add Gaussians where they are due. Raises TrainingFailed for a loss that is not finite."""
        progress = self.progress
        if self.growth_due and progress >= self.growth_due[0]:
            self._grow()
        self.step += 1
        factor = self._reduction(progress)
        target = self.view.reduced(factor)
        drawn = None if factor > 1 else self._drawn()
        self.engine.waves = None if drawn is None else drawn.waves
        # Random also behind an opaque photo: the viewer's own background would show through transparent parts.
        background = torch.rand(3, generator=self.random)
        result = self.engine.train_photo(
            target.viewmat,
            target.K,
            target.rgb,
            degree=0,
            rates=rates_at(progress, self.pixel),
            step=self.step,
            background=background,
            alpha=target.alpha,
            key=factor,
        )
        if not math.isfinite(result.loss):
            raise TrainingFailed(FailureName.non_finite, f"the loss became {result.loss}.", step=self.step)
        if drawn is not None and self.engine.wave_gradient is not None:
            drawn.move(self.engine.wave_gradient, fall_at(progress), self.step)

    def _drawn(self) -> FittedWaves | None:
        """The waves, once there are some."""
        return self.gabor if self.gabor is not None and len(self.gabor.waves.values) else None

    def evaluate(self) -> tuple[FitPoint, Tensor]:
        """The error against the picture over white, and the rendering [H, W, 3]."""
        color, target = self._rendered()
        score = compare(self.view.name, color, target.over(torch.ones(3)))
        return FitPoint(self.clock.seconds, self.step, self.engine.count, score), color

    def _rendered(self) -> tuple[Tensor, Target]:
        target = self.view.full
        camera = target.camera
        drawn = self._drawn()
        self.engine.waves = None if drawn is None else drawn.waves
        color, _, _ = self.engine.forward(
            target.viewmat, target.K, camera.width, camera.height, degree=0, background=torch.ones(3)
        )
        return color, target

    def _reduction(self, progress: float) -> int:
        factor = next(factor for share, factor in reversed(REDUCTIONS) if progress >= share)
        while factor > 1 and min(self.view.full.rgb.shape[:2]) < SMALLEST * factor:
            factor //= 2
        return factor

    def _grow(self) -> None:
        """Remove faint Gaussians, and add the next share where the squared error of the picture is large."""
        color, target = self._rendered()
        error = (color - target.over(torch.ones(3)).float() / 255.0).square().sum(dim=2)
        rows = Rows.of(self.engine)
        kept = torch.sigmoid(rows.gaussians.logit_opacities) > FAINT
        rows = rows.keep(kept)
        left = self.limit - rows.gaussians.count
        count = left if len(self.growth_due) == 1 else math.ceil(left / len(self.growth_due))
        self.growth_due.pop(0)
        if count > 0:
            rows = rows.grown(self._placed(_blurred(error), count).padded(3))
        stacked = self._stacked(rows.gaussians)
        self.engine.waves = None
        self.engine.replace(stacked.parameters(), rows.exp_avg, rows.exp_avg_sq)
        if self.gabor is not None:
            self.gabor.follow(kept, max(0, count))
            if self._reduction(self.progress) == 1:
                self._begin_waves(self.gabor)

    def _begin_waves(self, gabor: FittedWaves) -> None:
        color, target = self._rendered()
        residual = target.over(torch.ones(3)).float() / 255.0 - color
        camera = target.camera
        parameters = self.engine.parameters()
        shown = projected_by(parameters, target.viewmat, target.K, camera.width, camera.height)
        gabor.begin(shown, residual)

    def _placed(self, weight: Tensor, count: int) -> Gaussians:
        """`count` new Gaussians at pixels drawn with probability `weight` [H, W], with the colours of the photo.

        A Gaussian is as wide as its share of the picture: where many are drawn, they are small.
        """
        target = self.view.full
        height, width = weight.shape
        if target.alpha is not None:
            weight = weight * (target.alpha > 0)
        weight = weight + max(1e-12, 1e-3 * float(weight.mean()))
        chance = (weight / weight.sum()).reshape(-1)
        if count > chance.numel() // 2:
            # By inverting the cumulative sum in float64: a large photo has more pixels than float32 has values.
            ends = chance.double().cumsum(0)
            places = torch.rand(count, dtype=torch.float64, generator=self.random) * ends[-1]
            drawn = torch.searchsorted(ends, places).clamp_max(chance.numel() - 1)
        else:
            # The largest of chance / Exp(1) are a sample without replacement (Efraimidis and Spirakis 2006);
            # torch.multinomial refuses more than 2^24 places.
            waits = torch.empty_like(chance).exponential_(generator=self.random).clamp_min(1e-30)
            drawn = (chance / waits).topk(count).indices
        rows, columns = drawn // width, drawn % width
        jitter = torch.rand(count, 2, generator=self.random)
        camera = target.camera
        x = (columns + jitter[:, 0] - camera.cx) * self.pixel
        y = (rows + jitter[:, 1] - camera.cy) / camera.fy
        share = 1.0 / (chance[drawn] * count)  # pixels per Gaussian
        sigma = (WIDTH * (share / math.pi).sqrt()).clamp(NARROWEST, max(height, width) / 8) * self.pixel
        log_scales = sigma.log()[:, None].repeat(1, 3)
        log_scales[:, 2] = math.log(FLAT)
        quats = torch.zeros(count, 4)
        quats[:, 0] = 1.0
        color = target.rgb.reshape(-1, 3)[drawn].float() / 255.0
        return Gaussians(
            torch.stack([x, y, torch.ones(count)], dim=1),
            log_scales,
            quats,
            torch.full((count,), math.log(FIRST_OPACITY / (1.0 - FIRST_OPACITY))),
            ((color - 0.5) / SH_C0)[:, None, :],
        )

    def _stacked(self, gaussians: Gaussians) -> Gaussians:
        """The same picture with every Gaussian at a depth of its own, later ones in front."""
        depth = 1.0 - THICKNESS * torch.arange(gaussians.count) / max(1, self.limit)
        ratio = depth / gaussians.means[:, 2]
        means = gaussians.means * ratio[:, None]
        log_scales = gaussians.log_scales.clone()
        log_scales[:, :2] += ratio.log()[:, None]
        return Gaussians(means, log_scales, gaussians.quats, gaussians.logit_opacities, gaussians.sh)


def fall_at(progress: float) -> float:
    """What learning rates are multiplied with at `progress`, 0 to 1: half a cosine from 1 to 0.02."""
    return 0.02 + 0.98 * 0.5 * (1.0 + math.cos(math.pi * progress))


def rates_at(progress: float, pixel: float) -> PlaneRates:
    """Learning rates at `progress`, 0 to 1: they fall by half a cosine, positions from 0.3 pixels a step.

    pixel: size of a pixel in the plane, world units.

    The rates are larger than a scene's: every step sees the whole picture, so that its gradient is not noisy.
    """
    fall = fall_at(progress)
    return PlaneRates(
        means=fall * 0.3 * pixel,
        log_scales=fall * 6e-2,
        quats=fall * 6e-2,
        logit_opacities=fall * 0.1,
        sh_dc=fall * 4e-2,
        sh_rest=0.0,
    )


def _detail(target: Target) -> Tensor:
    """Weight of each pixel for the first Gaussians [H, W]: the picture's gradient, blurred, plus its mean."""
    grey = target.rgb.float().mean(dim=2) / 255.0
    slope = torch.zeros_like(grey)
    slope[:, 1:] += (grey[:, 1:] - grey[:, :-1]).abs()
    slope[1:] += (grey[1:] - grey[:-1]).abs()
    return _blurred(slope) + slope.mean().clamp_min(1e-6)


def _blurred(plane: Tensor) -> Tensor:
    """The mean over 5 x 5 pixels, over those inside the image at its border."""
    return torch.nn.functional.avg_pool2d(plane[None, None], 5, stride=1, padding=2, count_include_pad=False)[
        0, 0
    ]
