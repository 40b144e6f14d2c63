"""One view of a scene: the differentiable renderer over the kernels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.scene import Camera
from splatmill_worker.splat.gaussians import Gaussians


class Rendering(NamedTuple):
    """color [H, W, 3] with the background blended in, alpha [H, W] in 0..1, depth [H, W] = sum w_i z_i."""

    color: Tensor
    alpha: Tensor
    depth: Tensor

    def expected_depth(self) -> Tensor:
        """Mean camera z of what was hit [H, W]; 0 where nothing was."""
        return torch.where(
            self.alpha > 0, self.depth / self.alpha.clamp_min(1e-10), torch.zeros_like(self.depth)
        )


def camera_tensors(camera: Camera, like: Tensor) -> tuple[Tensor, Tensor]:
    """viewmat [4, 4] and K [3, 3] of a camera in the dtype and on the device of `like`."""
    viewmat = torch.as_tensor(camera.viewmat).to(like.device, like.dtype)
    intrinsics = torch.as_tensor(camera.K).to(like.device, like.dtype)
    return viewmat, intrinsics


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: Tensor | Sequence[float] | None = None,
    degree: int | None = None,
    backend: ops.Backend | None = None,
    antialias: bool = False,
) -> Rendering:
    """Render `gaussians` as `camera` sees them; gradients flow to every parameter that asks for them.

    background: RGB in 0..1, black when None. degree: highest SH degree used, all that there is when None.
    backend: which kernels compute it, chosen by the tensors' device when None. antialias: compensate
    opacities for the 0.3 px dilation (Yu et al. 2024, Mip-Splatting). An absent backend is an error.
    """
    viewmat, intrinsics = camera_tensors(camera, gaussians.means)
    if background is not None:
        background = torch.as_tensor(background).to(gaussians.means.device, gaussians.means.dtype)
    projected = ops.project(
        gaussians.means,
        gaussians.log_scales,
        gaussians.quats,
        gaussians.logit_opacities,
        gaussians.sh,
        viewmat,
        intrinsics,
        camera.width,
        camera.height,
        degree=gaussians.degree if degree is None else min(degree, gaussians.degree),
        antialias=antialias,
        backend=backend,
    )
    bins = ops.bin(projected, camera.width, camera.height, backend=backend)
    color, alpha, depth = ops.composite(
        projected, bins, camera.width, camera.height, background=background, backend=backend
    )
    return Rendering(color, alpha, depth)
