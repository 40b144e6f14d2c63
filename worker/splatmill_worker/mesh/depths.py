"""Depth of a model in many views, kept where other views confirm it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.scene import Camera
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.render import camera_tensors
from splatmill_worker.splat.surface import surface

TRANSMITTANCE = 0.75
"""At which a ray has met the surface. Surfaces of a trained model are some Gaussians thick: where one half of the light
is left, the ray is behind the true surface (decisions: TRANSMITTANCE)."""

NEIGHBOURS = 6
"""Views that are asked about the depths of a view: those whose cameras are nearest."""

CONFIRMING = 2
"""Views among them that have to agree, or all where a scene has fewer."""

AGREEMENT = 0.01
"""Largest difference of two depths that agree, of the depth."""

GRAZING = 0.1
"""Smallest cosine between a surface's normal and the ray to it at which its depth is kept."""


@dataclass(frozen=True)
class View:
    """What one camera sees, on the CPU.

    camera: it.
    color: uint8 [H, W, 3].
    depth: [H, W] camera z, world units; 0 where none is known.
    """

    camera: Camera
    color: Tensor
    depth: Tensor

    def pixels(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Column and row int64 [n] of world points [n, 3], and their depths [n], which are 0 of those not in view."""
        viewmat, intrinsics = camera_tensors(self.camera, points)
        local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
        return pixels_of(local, intrinsics, self.camera.width, self.camera.height)

    def points(self) -> tuple[Tensor, Tensor]:
        """World points [n, 3] of the pixels with a depth, and the numbers [n] of these pixels, row by row."""
        numbers = self.depth.reshape(-1).nonzero()[:, 0]
        z = self.depth.reshape(-1)[numbers]
        rows = torch.div(numbers, self.camera.width, rounding_mode="floor")
        x, y = self.camera.normalized(numbers % self.camera.width + 0.5, rows + 0.5)
        viewmat, _ = camera_tensors(self.camera, z)
        local = torch.stack([x * z, y * z, z], 1)
        return (local - viewmat[:3, 3]) @ viewmat[:3, :3], numbers


def pixels_of(local: Tensor, intrinsics: Tensor, width: int, height: int) -> tuple[Tensor, Tensor, Tensor]:
    """Column, row and depth of points [..., 3] in the camera's frame; the depth is 0 of those not in the image."""
    x, y, z = local.unbind(-1)
    ahead = z > 0
    safe = torch.where(ahead, z, 1.0)
    column = (x / safe * intrinsics[0, 0] + intrinsics[0, 2]).floor()
    row = (y / safe * intrinsics[1, 1] + intrinsics[1, 2]).floor()
    ahead = ahead & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    column = column.clamp(0, width - 1).long()
    return column, row.clamp(0, height - 1).long(), torch.where(ahead, z, 0.0)


def views_of(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    *,
    antialias: bool,
    backend: ops.Backend | None,
    told: Callable[[int], None],
) -> list[View]:
    """What each of the cameras sees of the model, without surfaces that it only grazes. `told` hears of each view."""
    views = []
    for index, camera in enumerate(cameras):
        rendering = surface(
            gaussians, camera, transmittance=TRANSMITTANCE, antialias=antialias, backend=backend
        )
        depth, normal = rendering.depth.cpu(), rendering.normal.cpu()
        columns, rows = torch.arange(camera.width) + 0.5, torch.arange(camera.height) + 0.5
        x, y = camera.normalized(columns, rows)
        rays = torch.stack([*torch.meshgrid(x, y, indexing="xy"), torch.ones_like(depth)], -1)
        viewmat, _ = camera_tensors(camera, depth)
        towards = -torch.nn.functional.normalize(rays, dim=-1) @ viewmat[:3, :3]
        facing = (towards * normal).sum(-1) > GRAZING
        color = (rendering.color.cpu().clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)
        views.append(View(camera, color, torch.where(facing, depth, 0.0)))
        told(index + 1)
    return views


def confirmed(views: Sequence[View]) -> list[View]:
    """The views with only those depths that CONFIRMING of the NEIGHBOURS nearest views agree with."""
    needed = min(CONFIRMING, len(views) - 1)
    kept = []
    for view, neighbours in zip(views, _nearest([view.camera for view in views]), strict=True):
        points, numbers = view.points()
        votes = torch.zeros(len(points), dtype=torch.int64)
        for other in neighbours:
            column, row, z = views[other].pixels(points)
            difference = (views[other].depth[row, column] - z).abs()
            votes += (z > 0) & (difference < AGREEMENT * z)
        depth = torch.zeros_like(view.depth)
        depth.view(-1)[numbers] = torch.where(votes >= needed, view.depth.view(-1)[numbers], 0.0)
        kept.append(View(view.camera, view.color, depth))
    return kept


def _nearest(cameras: Sequence[Camera]) -> list[list[int]]:
    """For each camera the numbers of its NEIGHBOURS nearest others, among those that look to the same side."""
    centers = torch.tensor([camera.center.tolist() for camera in cameras], dtype=torch.float64)
    axes = torch.tensor([camera.axis.tolist() for camera in cameras], dtype=torch.float64)
    distances = torch.cdist(centers, centers)
    distances = distances.masked_fill(axes @ axes.T < 0.5, torch.inf).fill_diagonal_(torch.inf)
    order = torch.argsort(distances, dim=1, stable=True)[:, :NEIGHBOURS]
    return [[j for j in row if torch.isfinite(distances[i, j])] for i, row in enumerate(order.tolist())]
