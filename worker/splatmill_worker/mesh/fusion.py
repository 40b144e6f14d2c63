"""A truncated signed distance field in blocks along the surface (Curless & Levoy 1996; Niessner et al. 2013).

A voxel holds the mean signed distance to the surfaces that the views see along their rays, in units of the truncation,
and the number of views. Only blocks within the truncation of some depth exist.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from splatmill_worker.mesh.depths import View, pixels_of
from splatmill_worker.splat.render import camera_tensors

Corners = tuple[tuple[float, float, float], tuple[float, float, float]]
"""The lower and the upper corner of a box."""

SIDE = 8
"""Voxels of a block along each axis."""

TRUNCATION = 4.0
"""Voxels in front of a surface and behind it that know their distance."""

MOST_BLOCKS = 40_000
"""Blocks of a field. With 512 voxels of eight bytes each, and what surface extraction adds, they take 0.4 GB."""

COARSER = 1.15
"""Factor on the voxels' size until no more than MOST_BLOCKS are needed."""

AT_ONCE = 2048
"""Blocks that are compared with a view at a time."""

GRID, MARGIN = 16, 16
"""Pixels between the places where the largest depth around them is known, and how far around."""

_BITS, _MIDDLE = 20, 1 << 19
"""Bits of a block's or cell's coordinate in its key, and what is added so that it is not negative."""


class TooLarge(Exception):
    """The depths reach too far for voxels of the size asked for."""


@dataclass(frozen=True)
class Field:
    """The field, on the CPU.

    origin: [3] float64, the world position of the corner of voxel (0, 0, 0) of block (0, 0, 0).
    voxel: side of a voxel, world units; a value stands at its voxel's first corner.
    blocks: [B, 3] int64 coordinates of the blocks, in the order of their keys.
    distances: [B, SIDE, SIDE, SIDE] from -1 inside to 1 outside, in units of the truncation.
    weights: of the same shape, the number of views.
    """

    origin: Tensor
    voxel: float
    blocks: Tensor
    distances: Tensor
    weights: Tensor


@dataclass(frozen=True)
class Region:
    """The part of the world that gets a surface.

    depth: largest camera z of a surface, world units.
    box: its lower and its upper corner [3], world units; None: all of the world.
    """

    depth: float
    box: Corners | None = None

    def kept(self, points: Tensor, depths: Tensor) -> Tensor:
        """Which of points [n, 3] at depths [n] lie in the region, bool [n]."""
        keep = depths <= self.depth
        if self.box is not None:
            low, high = (points.new_tensor(corner) for corner in self.box)
            keep = keep & ((points >= low) & (points <= high)).all(1)
        return keep


def fuse(views: Sequence[View], voxel: float, region: Region, *, exact: bool = False) -> Field:
    """The field of the views, with voxels of the side `voxel` in world units or, unless it is `exact`, larger ones.

    Surfaces outside the region make no blocks; they still empty the space in front of them. Raises TooLarge where more
    than MOST_BLOCKS blocks are needed at the exact size.
    """
    origin = torch.tensor([view.camera.center.tolist() for view in views], dtype=torch.float64).mean(0)
    while len(blocks := _blocks(views, origin, voxel, region)) > MOST_BLOCKS:
        if exact:
            raise TooLarge(
                f"A voxel of {voxel:.4g} needs {len(blocks)} blocks of {SIDE} voxels a side; at most {MOST_BLOCKS} are "
                "kept."
            )
        voxel *= COARSER
    shape = (len(blocks), SIDE, SIDE, SIDE)
    field = Field(origin, voxel, blocks, torch.zeros(shape), torch.zeros(shape))
    for view in views:
        _add(field, view)
    field.distances.div_(field.weights.clamp_min(1.0))
    return field


def key_of(coordinates: Tensor) -> Tensor:
    """One int64 for each of coordinates [..., 3], which sorts as they do, axis by axis."""
    x, y, z = (coordinates + _MIDDLE).unbind(-1)
    return (x << 2 * _BITS) | (y << _BITS) | z


def coordinates_of(keys: Tensor) -> Tensor:
    """Coordinates [n, 3] of keys [n]."""
    mask = (1 << _BITS) - 1
    return torch.stack([keys >> 2 * _BITS, keys >> _BITS & mask, keys & mask], 1) - _MIDDLE


def _blocks(views: Sequence[View], origin: Tensor, voxel: float, region: Region) -> Tensor:
    """Coordinates [B, 3] of the blocks that a ray enters within the truncation of its depth."""
    side, reach = voxel * SIDE, voxel * TRUNCATION
    keys = []
    for view in views:
        points, numbers = view.points()
        points = points[region.kept(points, view.depth.reshape(-1)[numbers])]
        center = torch.as_tensor(view.camera.center)
        away = torch.nn.functional.normalize(points.double() - center, dim=1)
        near = points.double() - origin
        for step in (-reach, 0.0, reach):
            cells = ((near + step * away) / side).floor().long()
            keys.append(torch.unique(key_of(cells)))
    return coordinates_of(torch.unique(torch.cat(keys)))


def _add(field: Field, view: View) -> None:
    """Add a view to the sums of the voxels that it sees in front of its surface or within the truncation behind it."""
    side, reach = field.voxel * SIDE, field.voxel * TRUNCATION
    camera = view.camera
    viewmat, intrinsics = camera_tensors(camera, field.distances)
    turn = viewmat[:3, :3]
    offset = torch.as_tensor(camera.center) - field.origin
    corners = (field.blocks.double() * side - offset).float() @ turn.T  # in the camera's frame
    step = torch.arange(SIDE, dtype=torch.float32) * field.voxel
    steps = torch.stack(torch.meshgrid(step, step, step, indexing="ij"), -1).reshape(-1, 3) @ turn.T
    middle = corners + 0.5 * side * turn.sum(1)
    radius = 0.5 * side * 3**0.5
    seen = _in_view(middle, radius, view, reach)
    flat_distances, flat_weights = field.distances.view(-1, SIDE**3), field.weights.view(-1, SIDE**3)
    depth = view.depth.reshape(-1)
    for rows in torch.split(seen, AT_ONCE):
        local = corners[rows][:, None] + steps
        column, row, z = pixels_of(local, intrinsics, camera.width, camera.height)
        surface = depth[row * camera.width + column]
        along = torch.linalg.vector_norm(local, dim=-1) / local[..., 2].abs().clamp_min(1e-12)
        distance = (surface - z) * along / reach
        known = (z > 0) & (surface > 0) & (distance > -1.0)
        flat_distances[rows] += torch.where(known, distance.clamp_max(1.0), 0.0)
        flat_weights[rows] += known


def _in_view(middle: Tensor, radius: float, view: View, reach: float) -> Tensor:
    """Numbers of the blocks, by their middles [B, 3] in the camera's frame, that the view may see or see into."""
    camera = view.camera
    x, y, z = middle.unbind(1)
    left, right = -camera.cx / camera.fx, (camera.width - camera.cx) / camera.fx
    top, bottom = -camera.cy / camera.fy, (camera.height - camera.cy) / camera.fy
    seen = z > -radius
    for along, low, high in ((x, left, right), (y, top, bottom)):  # the sides of the frustum
        seen &= along - low * z > -radius * (1 + low * low) ** 0.5
        seen &= along - high * z < radius * (1 + high * high) ** 0.5
    # What lies behind the largest depth within MARGIN pixels of its cell of GRID by more than the truncation is hidden.
    most = torch.nn.functional.max_pool2d(
        view.depth[None, None], 2 * (MARGIN + GRID // 2) + 1, GRID, MARGIN + GRID // 2
    )[0, 0]
    near = z.clamp_min(radius)
    column = ((x / near * camera.fx + camera.cx) / GRID).round().clamp(0, most.shape[1] - 1).long()
    row = ((y / near * camera.fy + camera.cy) / GRID).round().clamp(0, most.shape[0] - 1).long()
    large = radius * max(camera.fx, camera.fy) > MARGIN * (near - radius)
    seen &= large | (z - radius - reach < most[row, column])
    return seen.nonzero()[:, 0]
