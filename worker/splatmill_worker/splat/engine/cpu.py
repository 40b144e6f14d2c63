"""The fused CPU step as an Engine, which keeps the statistics of photos between their visits."""

from __future__ import annotations

from collections.abc import Hashable

from torch import Tensor

from splatmill_worker.kernels.cpu.loss import STATISTICS_PER_PIXEL, PhotoStats, photo_stats
from splatmill_worker.kernels.cpu.step import Step
from splatmill_worker.kernels.records import PartOf, Rates
from splatmill_worker.splat.engine.protocol import StepResult
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.views import over

MOST_KEPT = 400 * 10**6
"""Memory for the photos' statistics, bytes, where no other is set."""


class CpuEngine(Step):
    """An Engine on the C++ kernels, with as many threads as the kernels choose where `threads` is None.

    clustered, context: as in `Step`.
    most_kept: memory for the photos' statistics, bytes. Those of further photos are computed at every visit.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        *,
        threads: int | None = None,
        clustered: bool = False,
        context: Gaussians | None = None,
        most_kept: int = MOST_KEPT,
    ) -> None:
        super().__init__(
            **gaussians.padded(3).parameters(),
            threads=threads,
            clustered=clustered,
            context=None if context is None else context.padded(3).parameters(),
        )
        self.keep_pose_gradient = False
        self._kept: dict[Hashable, PhotoStats] = {}
        self._kept_bytes, self._most_kept = 0, most_kept

    def backward_update(
        self,
        d_color: Tensor,
        d_alpha: Tensor | None = None,
        d_depth: Tensor | None = None,
        *,
        rates: Rates,
        step: int,
        pose_gradient: bool = False,
    ) -> int:
        asked = pose_gradient or self.keep_pose_gradient
        return super().backward_update(d_color, d_alpha, d_depth, rates=rates, step=step, pose_gradient=asked)

    def train_photo(
        self,
        viewmat: Tensor,
        K: Tensor,
        photo: Tensor,
        *,
        degree: int,
        rates: Rates,
        step: int,
        background: Tensor | None = None,
        alpha: Tensor | None = None,
        mask: Tensor | None = None,
        antialias: bool = False,
        key: Hashable | None = None,
        part_of: PartOf | None = None,
    ) -> StepResult:
        result = self.train(
            viewmat,
            K,
            None,
            degree=degree,
            rates=rates,
            step=step,
            background=background,
            photo_stats=self._stats(photo, mask, key)
            if alpha is None
            else photo_stats(over(photo, alpha, background), mask=mask),
            antialias=antialias,
            pose_gradient=self.keep_pose_gradient,
            part_of=part_of,
        )
        return StepResult(result.loss, result.visible)

    def _stats(self, photo: Tensor, mask: Tensor | None, key: Hashable | None) -> PhotoStats:
        """The part of the loss that depends on the photo alone, kept under `key` while there is room."""
        if key is not None and key in self._kept:
            return self._kept[key]
        stats = photo_stats(photo, mask=mask)
        size = STATISTICS_PER_PIXEL * stats.used.numel()
        if key is not None and self._kept_bytes + size <= self._most_kept:
            self._kept[key] = stats
            self._kept_bytes += size
        return stats
