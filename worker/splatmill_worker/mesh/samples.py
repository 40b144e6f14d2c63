"""Points of the surface that many views see, with their normals: what a mesh is laid through."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from splatmill_worker.mesh.depths import GRAZING, View

Corners = tuple[tuple[float, float, float], tuple[float, float, float]]
"""The lower and the upper corner of a box."""

MOST = 700_000
"""Points of a mesh at most: of more pixels, a random choice. They decide its seconds and memory (decisions: NEAR)."""

_MIXER = 2654435761
"""Knuth's multiplier: pixels are chosen by the product of their number with it, so that they form no pattern."""


@dataclass(frozen=True)
class Region:
    """The part of the world that gets a surface.

    depth: largest camera z of a surface, world units.
    box: its lower and its upper corner [3], world units; None: all of the world.
    """

    depth: float
    box: Corners | None = None

    def of(self, view: View) -> Tensor:
        """Which of the view's points [n, 3] lie in the region, bool [n]."""
        points, numbers = view.points()
        keep = view.depth.reshape(-1)[numbers] <= self.depth
        if self.box is not None:
            low, high = (points.new_tensor(corner) for corner in self.box)
            keep = keep & ((points >= low) & (points <= high)).all(1)
        return keep


@dataclass(frozen=True)
class Samples:
    """Points [n, 3] of the surface, world units, and their unit normals [n, 3], which face the camera."""

    points: Tensor
    normals: Tensor


def samples_of(views: Sequence[View], region: Region) -> Samples:
    """The pixels of all views whose depth and whose neighbours' is known, in the region; MOST of them at most."""
    pixels = sum(int(region.of(view).sum()) for view in views)
    share = min(1.0, MOST / max(1, pixels))
    parts = [_of_view(view, region, share) for view in views]
    points, normals = (torch.cat(column) for column in zip(*parts, strict=True))
    return Samples(points, normals)


def _of_view(view: View, region: Region, share: float) -> tuple[Tensor, Tensor]:
    points, numbers = view.points()
    whole = torch.full((view.depth.numel(), 3), torch.nan)
    whole[numbers] = points
    grid = whole.view(*view.depth.shape, 3)
    across, down = grid.roll(-1, 1) - grid.roll(1, 1), grid.roll(-1, 0) - grid.roll(1, 0)
    # Not the normals of the Gaussians: that of a round one faces each camera (decisions: mesh-normals).
    # Rows run down and columns to the right, so that the product points away from the camera.
    normal = -torch.nn.functional.normalize(torch.linalg.cross(across, down), dim=-1).view(-1, 3)[numbers]
    towards = torch.nn.functional.normalize(torch.as_tensor(view.camera.center).float() - points, dim=1)
    # NaN beside unknown depths. At the edge of a thing, the product is that of the gap behind it.
    good = (normal * towards).sum(1) > GRAZING
    good &= region.of(view)
    good &= numbers * _MIXER % 2**32 < share * 2**32
    return points[good], normal[good]
