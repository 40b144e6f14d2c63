"""What the training loop asks of a backend: parameters, moments and scores of a scene, and one step over them."""

from __future__ import annotations

from collections.abc import Hashable
from typing import NamedTuple, Protocol

from torch import Tensor

from splatmill_worker.kernels.records import Rates


class StepResult(NamedTuple):
    """Loss of one step, and what it looked at."""

    loss: float
    visible: int
    pairs: int


class Engine(Protocol):
    """One scene under optimisation. The fused CPU step and the autograd step both are one.

    Scores are sums since the last `replace`, one value per Gaussian: `plain_sum` of the norm of the gradient of the
    projected mean in NDC units, `visible_count` of steps that saw it, `max_extent` its largest half size over half the
    photo's longer side. `keep_scores` says whether they will be read.

    With `keep_pose_gradient`, every step leaves in `pose_gradient` [6] the loss's gradient to a twist (rho, phi) of the
    camera exp(twist^) viewmat, as `kernels.cpu.step` defines it.
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

    def parameters(self) -> dict[str, Tensor]:
        """Copies by name, as in Gaussians; sh has 16 coefficients."""

    def moments(self) -> tuple[Tensor, Tensor]:
        """Adam's first and second moments [N, 59] each, in the engine's own column order."""

    def replace(
        self, parameters: dict[str, Tensor], exp_avg: Tensor | None, exp_avg_sq: Tensor | None
    ) -> None:
        """Take over other parameters and moments (None: zero); scores start again at zero."""

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
        """Colour [H, W, 3], alpha [H, W] and depth [H, W]; valid until the next call."""

    def backward_update(
        self,
        d_color: Tensor,
        d_alpha: Tensor | None = None,
        d_depth: Tensor | None = None,
        *,
        rates: Rates,
        step: int,
    ) -> object:
        """Gradients of the last forward pass, and one Adam step (1-based number `step`)."""

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
        """Forward, loss against `photo` uint8 [H, W, 3], backward and Adam.

        A `key` promises the same photo and mask whenever it comes again, so that work on them may be kept.
        """
