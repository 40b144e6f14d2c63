"""The fused GPU step as the training loop drives it."""

from __future__ import annotations

from collections.abc import Hashable

from torch import Tensor

from splatmill_worker.kernels.gpu.step import Step, Together
from splatmill_worker.kernels.records import Rates
from splatmill_worker.splat.engine.protocol import StepResult
from splatmill_worker.splat.gaussians import Gaussians


class FusedGpuStep(Step):
    """An Engine on the Triton kernels. Photos stay on the device as uint8 for as long as their tensors
    live.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        *,
        where: str | None = None,
        together: Together | None = None,
    ) -> None:
        self.keep_pose_gradient = (
            False  # the plan refuses to refine poses here: these kernels have no such gradient
        )
        self.pose_gradient: Tensor | None = None
        super().__init__(**gaussians.padded(3).parameters(), where=where, together=together)

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
        mask: Tensor | None = None,
        antialias: bool = False,
        key: Hashable | None = None,
    ) -> StepResult:
        """One step, enqueued; the numbers are those of the latest step that has been heard from.

        The promise in `key` is not needed: the photo's window sums cost the device less than the memory to
        keep them.
        """
        seen = self.train(
            viewmat, K, photo,
            degree=degree, rates=rates, step=step, background=background, mask=mask, antialias=antialias,
        )  # fmt: skip
        return StepResult(seen.loss, seen.visible, seen.pairs)
