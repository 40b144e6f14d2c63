"""The surface that one view of a scene shows: colour, median depth and normal of each pixel.

A Gaussian counts as the plane through its centre along which its density is largest on every ray. Under the linearised
projection that is the mean of its depth at a given pixel: at the centre, the depth changes by Cov(z, pixel)
Cov(pixel)^-1 per pixel. Its normal is that of the same plane: Sigma^-1 d for the viewing direction
d (Zhang et al. 2024, RaDe-GS). Training has no loss on it (decisions: surface-loss).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.records import MEDIAN, Projected
from splatmill_worker.kernels.reference.project import rotation
from splatmill_worker.scene import Camera
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.render import binned, camera_tensors

THINNEST = 0.01
"""Added to both variances of a projected Gaussian, pixels^2, where its depth follows its plane. A disc that is seen
from the side would have any depth within a pixel (decisions: THINNEST)."""


class Surface(NamedTuple):
    """What one view shows.

    color: [H, W, 3], blended over black.
    depth: [H, W] camera z where the transmittance falls to `transmittance`, world units; 0 where it does not.
    normal: [H, W, 3] unit vectors in the world that face the camera; 0 where nothing is drawn.
    """

    color: Tensor
    depth: Tensor
    normal: Tensor


class Planes(NamedTuple):
    """The plane of each Gaussian in one view; 0 of those that are culled.

    tilts: [N, 2] relative change of the depth by pixel in x and y at the centre, as `ops.median_depth` takes it.
    normals: [N, 3] unit vectors in the world that face the camera.
    """

    tilts: Tensor
    normals: Tensor


@torch.no_grad()
def surface(
    gaussians: Gaussians,
    camera: Camera,
    *,
    transmittance: float = MEDIAN,
    antialias: bool = False,
    backend: ops.Backend | None = None,
) -> Surface:
    """The surface of `gaussians` in the view of `camera`, on the backend that `render` takes; without gradients.

    transmittance: at which a pixel has its depth, 0.1 to 1.
    """
    width, height = camera.width, camera.height
    projected, bins = binned(gaussians, camera, antialias=antialias, backend=backend)
    planes = planes_of(gaussians, camera, projected)
    color, _, _ = ops.composite(projected, bins, width, height, backend=backend)
    normals = projected._replace(colors=planes.normals)
    normal, _, _ = ops.composite(normals, bins, width, height, backend=backend)
    depth = ops.median_depth(
        projected, bins, width, height, tilts=planes.tilts, transmittance=transmittance, backend=backend
    )
    return Surface(color, depth, torch.nn.functional.normalize(normal, dim=-1, eps=1e-6))


def planes_of(gaussians: Gaussians, camera: Camera, projected: Projected) -> Planes:
    """The planes of `gaussians` in a view where they are `projected`; in float64, since thin discs need the digits."""
    rows = (projected.extents > 0).all(1).nonzero()[:, 0]
    like = gaussians.means
    means, log_scales, quats = (
        value[rows].double() for value in (like, gaussians.log_scales, gaussians.quats)
    )
    viewmat, _ = camera_tensors(camera, means)
    turn, shift = viewmat[:3, :3], viewmat[:3, 3]
    local = means @ turn.T + shift
    z = local[:, 2]
    # The linearised projection is evaluated at most 15 % outside the image, as by `project`.
    low, high = ((torch.as_tensor(edge).to(means) for edge in corner) for corner in _limits(camera))
    u, v = ((local[:, i] / z).clamp(a, b) for i, (a, b) in enumerate(zip(low, high, strict=True)))
    axes = rotation(quats)
    factor = axes * torch.exp(log_scales)[:, None, :]
    rays = torch.stack([turn[0] - u[:, None] * turn[2], turn[1] - v[:, None] * turn[2]], 1)
    across = torch.einsum("nij,njk->nik", rays, factor) * (
        torch.tensor([camera.fx, camera.fy]).to(means)[:, None] / z[:, None, None]
    )
    along = torch.einsum("j,njk->nk", turn[2], factor)
    m0, m1 = across.unbind(1)
    a, b, c = (m0 * m0).sum(1), (m0 * m1).sum(1), (m1 * m1).sum(1)
    det = (torch.linalg.cross(m0, m1) ** 2).sum(1) + THINNEST * (a + c) + THINNEST**2
    zx, zy = (m0 * along).sum(1), (m1 * along).sum(1)
    tilt = torch.stack([(c + THINNEST) * zx - b * zy, (a + THINNEST) * zy - b * zx], 1) / (det * z)[:, None]
    direction = means - torch.as_tensor(camera.center).to(means)
    flatness = torch.exp(2.0 * (log_scales.amin(1, keepdim=True) - log_scales))
    normal = torch.einsum("nij,nj->ni", axes, flatness * torch.einsum("nij,ni->nj", axes, direction))
    normal = -torch.nn.functional.normalize(normal, dim=1)
    tilts, normals = like.new_zeros(gaussians.count, 2), torch.zeros_like(like)
    tilts[rows], normals[rows] = tilt.to(like), normal.to(like)
    return Planes(tilts, normals)


def _limits(camera: Camera) -> tuple[tuple[float, float], tuple[float, float]]:
    """Smallest and largest x/z and y/z at which `project` evaluates its derivative."""
    low = (-(0.15 * camera.width + camera.cx) / camera.fx, -(0.15 * camera.height + camera.cy) / camera.fy)
    high = (
        (1.15 * camera.width - camera.cx) / camera.fx,
        (1.15 * camera.height - camera.cy) / camera.fy,
    )
    return low, high
