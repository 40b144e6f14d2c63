"""The engine that differentiates the definition with torch's autograd, in float64."""

from __future__ import annotations

from collections.abc import Hashable

import torch
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.records import BETA1, EPS, PartOf, Rates
from splatmill_worker.splat.engine.protocol import StepResult
from splatmill_worker.splat.gaussians import Gaussians, concatenate
from splatmill_worker.splat.motion import motion
from splatmill_worker.splat.views import over

BACKEND: ops.Backend = "reference"


class AutogradEngine:
    """An Engine over the reference's ops in float64: slow, with the steps that the fused engines should take.

    It takes no other backend: `cpu` and `gpu` pass conics of three float32 numbers from one separate op to the next,
    from which a needle's gradient comes out with no right digit (docs/programming/precision.md). Their fused steps
    train instead.

    Adam updates all Gaussians; those that a photo does not show have a zero gradient. Scores are always kept, whatever
    `keep_scores` says, because autograd has them anyway.

    context: Gaussians that are rendered with the others, and that nothing moves.
    """

    def __init__(self, gaussians: Gaussians, *, context: Gaussians | None = None) -> None:
        self._context = None if context is None else context.padded(3).map(lambda value: value.double())
        self.keep_scores = True
        self.keep_pose_gradient = False
        self.pose_gradient: Tensor | None = None
        self.replace(gaussians.padded(3).parameters(), None, None)

    @property
    def count(self) -> int:
        return self._gaussians.count

    @property
    def logit_opacities(self) -> Tensor:
        return self._gaussians.logit_opacities.detach()

    def parameters(self) -> dict[str, Tensor]:
        return {name: value.detach().float() for name, value in self._gaussians.parameters().items()}

    def moments(self) -> tuple[Tensor, Tensor]:
        return self._packed(self._exp_avg).float(), self._packed(self._exp_avg_sq).float()

    def replace(
        self, parameters: dict[str, Tensor], exp_avg: Tensor | None, exp_avg_sq: Tensor | None
    ) -> None:
        leaves = {
            name: value.detach().to(torch.float64, copy=True).requires_grad_()
            for name, value in parameters.items()
        }
        self._gaussians = Gaussians(**leaves)
        self._exp_avg = self._unpacked(exp_avg)
        self._exp_avg_sq = self._unpacked(exp_avg_sq)
        self.plain_sum = torch.zeros(self.count)
        self.visible_count = torch.zeros(self.count)
        self.max_extent = torch.zeros(self.count)
        self._twist: Tensor | None = None
        self._pending: tuple[ops.Projected, Tensor, Tensor, Tensor] | None = None

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
        gaussians = self._gaussians if self._context is None else concatenate(self._gaussians, self._context)
        self._twist = None
        if self.keep_pose_gradient and torch.is_grad_enabled():
            self._twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
            viewmat = motion(self._twist) @ viewmat.double()
        projected = ops.project(
            gaussians.means,
            gaussians.log_scales,
            gaussians.quats,
            gaussians.logit_opacities,
            gaussians.sh,
            viewmat.double(),
            K.double(),
            width,
            height,
            degree=degree,
            antialias=antialias,
            backend=BACKEND,
        )
        if projected.means2d.requires_grad:
            projected.means2d.retain_grad()
        bins = ops.bin(projected, width, height, backend=BACKEND)
        background = None if background is None else background.double()
        color, alpha, depth = ops.composite(
            projected, bins, width, height, background=background, backend=BACKEND
        )
        self._pending = (projected, color, alpha, depth)
        return color.detach().float(), alpha.detach().float(), depth.detach().float()

    def backward_update(
        self,
        d_color: Tensor,
        d_alpha: Tensor | None = None,
        d_depth: Tensor | None = None,
        *,
        rates: Rates,
        step: int,
        part_of: PartOf | None = None,
    ) -> None:
        if self._pending is None:
            raise RuntimeError("backward_update needs a forward pass before it.")
        projected, *outputs = self._pending
        pairs = [
            (out, grad.to(out))
            for out, grad in zip(outputs, (d_color, d_alpha, d_depth), strict=True)
            if grad is not None
        ]
        torch.autograd.backward([out for out, _ in pairs], [grad for _, grad in pairs])
        height, width = outputs[0].shape[:2]
        self._score(projected, *((width, height) if part_of is None else part_of[:2]))
        twist = None if self._twist is None else self._twist.grad
        self.pose_gradient = None if twist is None else twist.float()
        self._adam(rates, step)
        self._pending = None

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
        height, width = photo.shape[:2]
        self.forward(viewmat, K, width, height, degree=degree, background=background, antialias=antialias)
        if alpha is not None:
            photo = over(photo, alpha, background)
        assert self._pending is not None
        color = self._pending[1].detach().requires_grad_()
        loss = ops.loss(color, photo, mask=mask, backend=BACKEND)
        (gradient,) = torch.autograd.grad(loss, color)
        visible = int((self._pending[0].extents[:, 0] > 0).sum())
        if part_of is not None:
            used = photo[..., 0].numel() if mask is None else int(mask.count_nonzero())
            gradient = gradient * (used / part_of.used)
        self.backward_update(gradient, rates=rates, step=step, part_of=part_of)
        return StepResult(float(loss.detach()), visible)

    def _score(self, projected: ops.Projected, width: int, height: int) -> None:
        """Add this view to the densification scores."""
        gradient = projected.means2d.grad
        if gradient is None:
            return
        with torch.no_grad():
            visible = projected.extents[: self.count, 0] > 0
            ndc = gradient[: self.count] * gradient.new_tensor([width / 2, height / 2])
            self.plain_sum += torch.linalg.vector_norm(ndc, dim=1)
            self.visible_count += visible
            extent = 2.0 * projected.extents[: self.count].amax(dim=1).float() / max(width, height)
            self.max_extent = torch.maximum(self.max_extent, extent)

    def _adam(self, rates: Rates, step: int) -> None:
        """One step of Adam (Kingma & Ba 2015) with bias correction, on every parameter group."""
        correction = (1.0 - rates.beta2**step) ** 0.5 / (1.0 - BETA1**step)
        for name, value in self._gaussians.parameters().items():
            gradient = torch.zeros_like(value) if value.grad is None else value.grad
            average, square = self._exp_avg[name], self._exp_avg_sq[name]
            average.lerp_(gradient, 1.0 - BETA1)
            square.mul_(rates.beta2).addcmul_(gradient, gradient, value=1.0 - rates.beta2)
            move = correction * average / (square.sqrt() + EPS)
            with torch.no_grad():
                if name == "sh":
                    value[:, :1] -= rates.sh_dc * move[:, :1]
                    value[:, 1:] -= rates.sh_rest * move[:, 1:]
                else:
                    value -= getattr(rates, name) * move
            value.grad = None

    def _packed(self, groups: dict[str, Tensor]) -> Tensor:
        """All groups side by side [N, 59]."""
        return torch.cat([value.reshape(self.count, -1) for value in groups.values()], dim=1)

    def _unpacked(self, packed: Tensor | None) -> dict[str, Tensor]:
        """The groups of `packed` [N, 59] by name; zeros where it is None."""
        shapes = {name: value.shape for name, value in self._gaussians.parameters().items()}
        if packed is None:
            return {name: torch.zeros(shape, dtype=torch.float64) for name, shape in shapes.items()}
        widths = [shape[1:].numel() for shape in shapes.values()]
        parts = torch.split(packed, widths, dim=1)
        return {
            name: part.reshape(shape).to(torch.float64, copy=True)
            for (name, shape), part in zip(shapes.items(), parts, strict=True)
        }
