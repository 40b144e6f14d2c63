"""The surface of a view: depth and normals of a tilted plane made of discs, for ordinary and thin ones.

That the median depth picks the right splat is proved in tests/kernels/test_median_depth.py.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.records import Projected
from splatmill_worker.scene import Camera, viewmat_of
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.render import camera_tensors
from splatmill_worker.splat.surface import planes_of, surface

CAMERA = Camera(80, 60, 70.0, 70.0, 40.0, 30.0, viewmat_of(np.eye(3), np.array([0.3, -0.2, -4.0])))
TILT = math.radians(50)
NORMAL = np.array([math.sin(TILT), 0.0, -math.cos(TILT)])
"""Of the plane through the origin, towards the camera."""


def plane(thickness: float, spacing: float = 0.25) -> Gaussians:
    """Opaque discs in the plane, one and a half times as wide as they are apart."""
    along = torch.arange(-5.0, 5.0, spacing)
    u, v = (x.reshape(-1) for x in torch.meshgrid(along, along, indexing="ij"))
    across = torch.tensor([math.cos(TILT), 0.0, math.sin(TILT)])
    means = u[:, None] * across + v[:, None] * torch.tensor([0.0, 1.0, 0.0])
    n = len(means)
    scales = torch.tensor([0.75 * spacing, 0.75 * spacing, thickness])
    turn = -TILT / 2  # about y: the disc's thin axis z goes to the plane's normal
    return Gaussians(
        means,
        scales.log().repeat(n, 1),
        torch.tensor([math.cos(turn), 0.0, math.sin(turn), 0.0]).repeat(n, 1),
        torch.full((n,), 4.0),
        torch.zeros(n, 1, 3),
    )


def seen_by_the_camera(g: Gaussians) -> Projected:
    viewmat, K = camera_tensors(CAMERA, g.means)
    return ops.project(g.means, g.log_scales, g.quats, g.logit_opacities, g.sh, viewmat, K, 80, 60, degree=0)


def true_depth() -> Tensor:
    """Camera z of the plane at the centre of each pixel, and 0 where the plane is farther than its discs."""
    x, y = CAMERA.normalized(torch.arange(80) + 0.5, torch.arange(60) + 0.5)
    rays = torch.stack([*torch.meshgrid(x, y, indexing="xy"), torch.ones(60, 80)], -1).double()
    depth = -float(NORMAL @ CAMERA.center) / (rays @ torch.from_numpy(NORMAL))
    points = torch.from_numpy(CAMERA.center) + depth[..., None] * rays
    return torch.where((points.abs().amax(-1) < 3.0) & (depth > 0), depth, 0.0)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
@pytest.mark.parametrize("thickness", [1e-2, 1e-4, 1e-6])
def test_a_tilted_plane_has_its_depth_and_its_normal(thickness: float, backend: ops.Backend) -> None:
    maps, truth = surface(plane(thickness), CAMERA, backend=backend), true_depth()
    there = truth > 0
    assert there.sum() > 1000
    error = (maps.depth.double() - truth).abs()[there]
    # The discs are 0.19 wide, half of which is a depth of 0.14 at this tilt.
    assert float(error.quantile(0.99)) < 0.02
    cosine = (maps.normal.double() @ torch.from_numpy(NORMAL))[there]
    assert float(cosine.min()) > math.cos(math.radians(1.0))


def test_without_their_tilts_the_discs_would_be_steps() -> None:
    gaussians = plane(1e-3)
    projected = seen_by_the_camera(gaussians)
    bins = ops.bin(projected, 80, 60)
    truth = true_depth()
    errors = []
    for tilts in (planes_of(gaussians, CAMERA, projected).tilts, None):
        depth = ops.median_depth(projected, bins, 80, 60, tilts=tilts)
        errors.append(float((depth - truth).abs()[truth > 0].mean()))
    assert errors[0] < 0.2 * errors[1]


def test_what_is_culled_has_no_plane() -> None:
    gaussians = plane(1e-3).select(torch.arange(6))
    means = gaussians.means.clone()
    means[2] = torch.tensor([0.0, 0.0, -9.0])  # behind the camera
    means[3] = torch.nan
    changed = replace(gaussians, means=means)
    projected = seen_by_the_camera(changed)
    planes = planes_of(changed, CAMERA, projected)
    shown = (projected.extents > 0).all(1)
    assert not shown[2:4].any()
    assert (planes.tilts[~shown] == 0).all()
    assert (planes.normals[~shown] == 0).all()
    assert torch.allclose(planes.normals[shown].norm(dim=1), torch.ones(int(shown.sum())))


def test_nothing_has_no_surface() -> None:
    maps = surface(plane(1e-3).select(torch.arange(0)), CAMERA)
    assert not maps.depth.any()
    assert not maps.normal.any()
