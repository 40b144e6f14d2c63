"""One picture as a flat scene: Gaussians in a plane before one camera, fitted coarse to fine and added where it errs.

Loss, gradients and optimiser are those of training; left out is everything that only several views need: depth,
directions, SH above degree 0. The Gaussians are blended as every viewer of 3-D splats blends them, front to back,
not summed as in GaussianImage (Zhang et al. 2024), so that the file shows the picture anywhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from splatmill_worker.errors import FailureName, TrainingFailed
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
"""Depth of the slab over its distance. No two Gaussians share a depth, so that every viewer blends in this order."""

FLAT = 1e-5
"""Standard deviation across the slab over its distance: far under a pixel, and no zero for viewers to divide by."""

FIRST_SHARE = 0.1
"""Of the Gaussians there at the start; the others go where the picture errs."""

GROWN_AT = (0.06, 0.12, 0.18, 0.25, 0.32, 0.4, 0.48)
"""Shares of the budget at which Gaussians are added, the same number each time."""

REDUCTIONS = ((0.0, 4), (0.04, 2), (0.12, 1))
"""(share of the budget, by how much the picture is reduced from then on)."""

SMALLEST = 48
"""Pixels of the shorter side below which a reduced copy says too little."""

WIDTH = 0.25
"""Standard deviation of a new Gaussian over the radius of the disc that is its share of the picture."""

NARROWEST = 0.4  # pixels; the renderer's own dilation is 0.55
FIRST_OPACITY = 0.7
FAINT = 0.01
"""A Gaussian of less opacity was given up by the optimiser; its place is used for another."""

MEASURED_AT = (0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)


class PlaneRates(Rates):
    """Rates under which Gaussians stay in their plane: depth, thickness and the two turns out of it rest."""

    RESTING = (2, 5, 7, 8)  # z; scale along z; quaternion x and y

    def rows(self) -> list[float]:
        """One rate for each of the 59 rows of a block."""
        return [0.0 if i in self.RESTING else rate for i, rate in enumerate(super().rows())]


@dataclass(frozen=True)
class Row:
    """A point of error against time: PSNR in dB and SSIM at full size."""

    seconds: float
    step: int
    gaussians: int
    score: ViewScore


def camera_before(width: int, height: int) -> Camera:
    """The camera at the origin that sees a picture of this size, its longer side one unit long, one unit away."""
    focal = float(max(width, height))
    return Camera(width, height, focal, focal, width / 2, height / 2, np.eye(4))


def fit(
    view: TrainingView,
    gaussians: int,
    budget: Budget,
    *,
    seed: int = 0,
    measured: Callable[[Row], None] = lambda _: None,
    moments: tuple[float, ...] = (),
    frame: Callable[[Tensor, Row], None] = lambda _color, _row: None,
) -> tuple[Gaussians, list[Row]]:
    """Fit at most `gaussians` to `view`, which `camera_before` sees; returns them and the measured points.

    `measured` gets each point, `frame` a rendering [H, W, 3] at each of `moments` (shares of the budget). With
    alpha the picture is fitted over random backgrounds, so that it becomes transparent where the photo is.
    Measuring and frames are not on the clock. Raises TrainingFailed when the optimisation leaves the numbers.
    """
    run = _Fit(view, gaussians, budget, torch.Generator().manual_seed(seed))
    rows: list[Row] = []
    due = list(MEASURED_AT)
    wanted = list(moments)
    progress = 0.0
    while progress < 1.0:
        run.advance()
        progress = run.progress
        if due[0] <= progress or (wanted and wanted[0] <= progress):
            with run.clock.stopped():
                row, color = run.look()
                if due[0] <= progress:
                    due = [share for share in due if share > progress]
                    rows.append(row)
                    measured(row)
                if wanted and wanted[0] <= progress:
                    wanted = [share for share in wanted if share > progress]
                    frame(color, row)
    return gaussians_of(run.engine).padded(0), rows


class _Fit:
    def __init__(self, view: TrainingView, most: int, budget: Budget, random: torch.Generator) -> None:
        self.view, self.most, self.budget, self.random = view, most, budget, random
        full = view.full
        self.pixel = 1.0 / full.camera.fx
        first = max(1, round(FIRST_SHARE * most))
        self.engine = CpuEngine(self._stacked(self._placed(_detail(full), first)))
        self.engine.keep_scores = False
        self.step = 0
        self.events = list(GROWN_AT)
        self.clock = Clock()

    @property
    def progress(self) -> float:
        return self.budget.progress(self.step, self.clock.seconds)

    def advance(self) -> None:
        """One step, and new Gaussians where they are due."""
        progress = self.progress
        if self.events and progress >= self.events[0]:
            self._grow()
        self.step += 1
        factor = self._reduction(progress)
        target = self.view.reduced(factor)
        # Random also behind an opaque photo: what is left transparent would show the viewer's own background.
        background = torch.rand(3, generator=self.random)
        result = self.engine.train_photo(
            target.viewmat,
            target.K,
            target.over(background),
            degree=0,
            rates=rates_at(progress, self.pixel),
            step=self.step,
            background=background,
            key=factor if target.alpha is None else None,
        )
        if not math.isfinite(result.loss):
            raise TrainingFailed(FailureName.non_finite, f"the loss became {result.loss}.", step=self.step)

    def look(self) -> tuple[Row, Tensor]:
        """How near the picture is, over white where it is transparent, and the rendering [H, W, 3]."""
        color, target = self._rendered()
        score = compare(self.view.name, color, target.over(torch.ones(3)))
        return Row(self.clock.seconds, self.step, self.engine.count, score), color

    def _rendered(self) -> tuple[Tensor, Target]:
        target = self.view.full
        camera = target.camera
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
        """Give up the faint ones and add the next share of Gaussians, by the squared error of the picture."""
        color, target = self._rendered()
        error = (color - target.over(torch.ones(3)).float() / 255.0).square().sum(dim=2)
        rows = Rows.of(self.engine)
        rows = rows.keep(torch.sigmoid(rows.gaussians.logit_opacities) > FAINT)
        left = self.most - rows.gaussians.count
        count = left if len(self.events) == 1 else math.ceil(left / len(self.events))
        self.events.pop(0)
        if count > 0:
            rows = rows.grown(self._placed(_blurred(error), count).padded(3))
        stacked = self._stacked(rows.gaussians)
        self.engine.replace(stacked.parameters(), rows.exp_avg, rows.exp_avg_sq)

    def _placed(self, weight: Tensor, count: int) -> Gaussians:
        """New Gaussians [count] at pixels drawn by `weight` [H, W], coloured as the photo is there.

        Each is as wide as its share of the picture: where many are drawn, they are small.
        """
        target = self.view.full
        height, width = weight.shape
        if target.alpha is not None:
            weight = weight * (target.alpha > 0)
        weight = weight + max(1e-12, 1e-3 * float(weight.mean()))
        chance = (weight / weight.sum()).reshape(-1)
        if count > chance.numel() // 2:
            # By the inverse of the sum, in double precision: a large photo has more pixels than float32 has steps.
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
        share = 1.0 / (chance[drawn] * count)  # pixels for each
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
        """The same picture with the later ones before the earlier ones, each at a depth of its own."""
        depth = 1.0 - THICKNESS * torch.arange(gaussians.count) / max(1, self.most)
        ratio = depth / gaussians.means[:, 2]
        means = gaussians.means * ratio[:, None]
        log_scales = gaussians.log_scales.clone()
        log_scales[:, :2] += ratio.log()[:, None]
        return Gaussians(means, log_scales, gaussians.quats, gaussians.logit_opacities, gaussians.sh)


def rates_at(progress: float, pixel: float) -> PlaneRates:
    """Rates at a share of the budget; positions start at 0.3 pixels a step, and all fall by a half cosine.

    They are larger than those of a scene: every step sees the whole picture, so that its gradient has no noise.
    """
    fall = 0.02 + 0.98 * 0.5 * (1.0 + math.cos(math.pi * progress))
    return PlaneRates(
        means=fall * 0.3 * pixel,
        log_scales=fall * 6e-2,
        quats=fall * 6e-2,
        logit_opacities=fall * 0.1,
        sh_dc=fall * 4e-2,
        sh_rest=0.0,
    )


def _detail(target: Target) -> Tensor:
    """Where a picture needs Gaussians before any is there [H, W]: its slope, and everywhere a little."""
    grey = target.rgb.float().mean(dim=2) / 255.0
    slope = torch.zeros_like(grey)
    slope[:, 1:] += (grey[:, 1:] - grey[:, :-1]).abs()
    slope[1:] += (grey[1:] - grey[:-1]).abs()
    return _blurred(slope) + slope.mean().clamp_min(1e-6)


def _blurred(plane: Tensor) -> Tensor:
    """The mean over 5 x 5 pixels, or what there is of them."""
    return torch.nn.functional.avg_pool2d(plane[None, None], 5, stride=1, padding=2, count_include_pad=False)[
        0, 0
    ]
