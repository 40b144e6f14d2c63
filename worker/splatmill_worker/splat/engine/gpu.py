"""The fused GPU step as an Engine."""

from __future__ import annotations

from collections.abc import Hashable

from torch import Tensor

from splatmill_worker.kernels.gpu.step import Step
from splatmill_worker.kernels.records import PartOf, Rates
from splatmill_worker.splat.engine.protocol import StepResult
from splatmill_worker.splat.gaussians import Gaussians


class GpuEngine(Step):
    """An Engine on the Triton kernels. Photos stay on the device for as long as their tensors live.

    These kernels compute no gradient of the camera, so `pose_gradient` stays None; the plan refines no poses here.
    """

    def __init__(self, gaussians: Gaussians, *, where: str | None = None) -> None:
        self.keep_pose_gradient = False
        self.pose_gradient: Tensor | None = None
        super().__init__(**gaussians.padded(3).parameters(), where=where)

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
        """Enqueue one step; the result is that of the latest step whose numbers have reached the host.

        `key` is not used: what is kept of a photo is kept with its tensor.
        """
        if part_of is not None:
            raise ValueError("part_of: the gpu engine trains on whole photos")
        result = self.train(
            viewmat, K, photo, degree=degree, rates=rates, step=step, background=background, alpha=alpha, mask=mask,
            antialias=antialias,
        )  # fmt: skip
        return StepResult(result.loss, result.visible)
