"""The points and normals that a mesh is laid through: which pixels give one, and which normal it has.

How true the mesh through them is, is measured by `splatmill bench mesh`.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from splatmill_worker.mesh import samples
from splatmill_worker.mesh.depths import NORMAL_UNIT, View
from splatmill_worker.mesh.samples import Region, samples_of
from splatmill_worker.scene import Camera, viewmat_of

SIDE = 40
CAMERA = Camera(SIDE, SIDE, 50.0, 50.0, SIDE / 2, SIDE / 2, viewmat_of(np.eye(3), np.array([0.0, 0.0, -4.0])))
"""Four units in front of the wall z = 0, which it sees from the front."""

FACING = torch.tensor([0.0, 0.0, -1.0])
EVERYWHERE = Region(math.inf)


def wall(depth: Tensor, normal: Tensor) -> View:
    """What the camera sees of a wall with this depth [SIDE, SIDE], and one normal everywhere."""
    stored = (NORMAL_UNIT * normal).round().to(torch.int8).expand(SIDE, SIDE, 3).contiguous()
    return View(CAMERA, torch.zeros(SIDE, SIDE, 3, dtype=torch.uint8), depth, stored)


def rough(by: float) -> Tensor:
    """Depths of the wall that differ from it at random, world units."""
    random = torch.Generator().manual_seed(0)
    return 4.0 + by * torch.randn(SIDE, SIDE, generator=random)


def test_a_sample_has_the_normal_of_the_gaussians_and_not_of_the_rough_depth() -> None:
    tilted = torch.nn.functional.normalize(torch.tensor([0.3, -0.2, -1.0]), dim=0)
    found = samples_of([wall(rough(0.05), tilted)], EVERYWHERE)
    assert len(found.points) == SIDE * SIDE
    # Bytes hold a normal to within half a step in each of three numbers: sqrt(3) / 2 / 127.
    assert float((found.normals - tilted).norm(dim=1).max()) < 0.0069
    assert torch.allclose(found.normals.norm(dim=1), torch.ones(len(found.points)))


def test_every_known_depth_of_the_region_gives_a_sample_beside_unknown_ones_too() -> None:
    depth = torch.full((SIDE, SIDE), 4.0)
    depth[10, 10] = 0.0
    depth[:, 30:] = 9.0
    found = samples_of([wall(depth, FACING)], Region(8.0))
    seen = CAMERA.project(found.points.double().numpy())
    pixels = set(zip(seen.rows.astype(int).tolist(), seen.columns.astype(int).tolist(), strict=True))
    assert pixels == {(y, x) for y in range(SIDE) for x in range(30)} - {(10, 10)}
    assert len(found.points) == len(pixels)


def test_of_too_many_pixels_a_share_is_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    view = wall(torch.full((SIDE, SIDE), 4.0), FACING)
    every = len(samples_of([view], EVERYWHERE).points)
    monkeypatch.setattr(samples, "MOST", every // 4)
    assert 0.15 * every < len(samples_of([view], EVERYWHERE).points) < 0.35 * every
