"""The protocol between training and a backend: parameters, moments and scores of a scene, and one step."""

from __future__ import annotations

from collections.abc import Hashable
from typing import NamedTuple, Protocol

from torch import Tensor

from splatmill_worker.kernels.records import PartOf, Rates


class StepResult(NamedTuple):
    """What one training step measured.

    loss: training loss of the photo, before the step.
    visible: Gaussians that the photo shows.
    """

    loss: float
    visible: int


class Engine(Protocol):
    """One scene under optimisation, with Adam's moments and the scores for densification.

    keep_scores: whether the next steps add to the scores.
    keep_pose_gradient: whether the next steps leave a `pose_gradient`.
    pose_gradient: [6], gradient of the last step's loss with respect to a twist (rho, phi) of the camera
        exp(twist^) viewmat, as `kernels.cpu.step` defines it; None where there is none.
    count: number of Gaussians.
    plain_sum: [N], sum over steps of the norm of the gradient of the projected mean, in NDC units.
    visible_count: [N], steps whose photo showed the Gaussian.
    max_extent: [N], largest half side of its box in a photo, in halves of the photo's longer side.
    logit_opacities: the logits of the opacities themselves, in the engine's layout, to be written to between steps.

    The scores are sums and a maximum over the steps since the last `replace`.
    """

    keep_scores: bool
    keep_pose_gradient: bool
    pose_gradient: Tensor | None

    @property
    def count(self) -> int: ...
    @property
    def plain_sum(self) -> Tensor: ...
    @property
    def visible_count(self) -> Tensor: ...
    @property
    def max_extent(self) -> Tensor: ...
    @property
    def logit_opacities(self) -> Tensor: ...

    def parameters(self) -> dict[str, Tensor]:
        """Copies of the parameters by name, as in `Gaussians`; sh has 16 coefficients."""

    def moments(self) -> tuple[Tensor, Tensor]:
        """Adam's first and second moments, [N, 59] each, in a column order that `replace` of this engine takes."""

    def replace(
        self, parameters: dict[str, Tensor], exp_avg: Tensor | None, exp_avg_sq: Tensor | None
    ) -> None:
        """Take over other parameters and moments (zeros where None), and set the scores to zero."""

    def forward(
        self,
        viewmat: Tensor,
        K: Tensor,
        width: int,
        height: int,
        *,
        degree: int,
        background: Tensor | None = None,
        antialias: bool = False,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Render colour [H, W, 3], alpha [H, W] and depth [H, W]; the tensors are valid until the next call."""

    def backward_update(
        self,
        d_color: Tensor,
        d_alpha: Tensor | None = None,
        d_depth: Tensor | None = None,
        *,
        rates: Rates,
        step: int,
    ) -> object:
        """Differentiate the last forward pass and take one Adam step, of 1-based number `step`."""

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
        """Take one step on `photo` uint8 [H, W, 3]: render, loss over the pixels of `mask` [H, W], gradients, Adam.

        degree: spherical-harmonics degree that is rendered.
        rates: learning rates of the step.
        step: its 1-based number.
        background: RGB [3] behind the scene; black where None.
        alpha: uint8 [H, W] of a transparent photo, which is seen over the same background; None where it is opaque.
        antialias: compensate opacities for the dilation of small Gaussians.
        key: names the photo and its mask; the same key always comes with the same two, so work on them may be kept.
            Nobody writes into the tensors of photos, alphas and masks that were given.
        part_of: the photo that this one is a part of. The gradients are then those that the part has in the loss of
            that photo, and the scores count in its NDC units, so that a part is trained as the whole is. Not for gpu.
        """
