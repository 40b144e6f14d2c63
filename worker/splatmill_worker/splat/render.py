"""Renders one view of a scene, differentiably, on any backend."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.records import Bins, Projected
from splatmill_worker.scene import Camera
from splatmill_worker.splat.gaussians import Gaussians


class Rendering(NamedTuple):
    """One rendered view.

    color: [H, W, 3], blended over the background.
    alpha: [H, W], 0 to 1.
    depth: [H, W], sum of the Gaussians' camera z times their blending weights, world units.
    """

    color: Tensor
    alpha: Tensor
    depth: Tensor

    def expected_depth(self) -> Tensor:
        """Mean camera z of the Gaussians at each pixel [H, W], world units; 0 where there are none."""
        return torch.where(
            self.alpha > 0, self.depth / self.alpha.clamp_min(1e-10), torch.zeros_like(self.depth)
        )


def camera_tensors(camera: Camera, like: Tensor) -> tuple[Tensor, Tensor]:
    """viewmat [4, 4] and K [3, 3] of a camera in the dtype and on the device of `like`."""
    viewmat = torch.as_tensor(camera.viewmat).to(like.device, like.dtype)
    intrinsics = torch.as_tensor(camera.K).to(like.device, like.dtype)
    return viewmat, intrinsics


def binned(
    gaussians: Gaussians,
    camera: Camera,
    *,
    degree: int | None = None,
    antialias: bool = False,
    backend: ops.Backend | None = None,
) -> tuple[Projected, Bins]:
    """What `gaussians` project to in the view of `camera`, and their order in each tile; the arguments of `render`."""
    viewmat, intrinsics = camera_tensors(camera, gaussians.means)
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
    return projected, ops.bin(projected, camera.width, camera.height, backend=backend)


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: Tensor | Sequence[float] | None = None,
    degree: int | None = None,
    backend: ops.Backend | None = None,
    antialias: bool = False,
) -> Rendering:
    """Render `gaussians` as `camera` sees them; gradients flow to the parameters that require them.

    background: RGB in 0 to 1; black where None.
    degree: highest SH degree that is used; that of the Gaussians where None.
    backend: the kernels that compute it; chosen by the tensors' device where None. An absent backend is an error.
    antialias: compensate opacities for the dilation of 0.3 pixels^2 (Yu et al. 2024, Mip-Splatting).
    """
    if background is not None:
        background = torch.as_tensor(background).to(gaussians.means.device, gaussians.means.dtype)
    projected, bins = binned(gaussians, camera, degree=degree, antialias=antialias, backend=backend)
    color, alpha, depth = ops.composite(
        projected, bins, camera.width, camera.height, background=background, backend=backend
    )
    return Rendering(color, alpha, depth)
