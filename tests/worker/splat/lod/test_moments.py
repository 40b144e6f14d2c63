"""Proves what is kept when Gaussians are merged: mass, mean, covariance, colour, and the area that it is measured in.

Does not prove that pictures stay alike: `test_levels.py` does.
"""

from __future__ import annotations

import math

import torch

from splatmill_worker.kernels.reference.project import rotation
from splatmill_worker.splat.lod import moments
from splatmill_worker.splat.lod.moments import areas, extents, gaussians_of, merged, moments_of, quaternions
from tests.support.gaussians import differences, some_gaussians


def _full(covariances: torch.Tensor) -> torch.Tensor:
    xx, xy, xz, yy, yz, zz = covariances.unbind(1)
    return torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], 1).reshape(-1, 3, 3)


def test_gaussians_survive_as_moments() -> None:
    scene = some_gaussians(500, 2)
    back = gaussians_of(moments_of(scene))
    assert torch.allclose(
        _full(moments_of(back).shapes.covariances), _full(moments_of(scene).shapes.covariances), rtol=1e-5
    )
    errors = differences(back, scene)
    assert errors["means"] == 0
    assert errors["opacities"] < 1e-6
    assert errors["dc"] == 0
    assert torch.allclose(back.log_scales.sort(1).values, scene.log_scales.sort(1).values, atol=1e-5)


def test_a_quaternion_is_that_of_its_rotation() -> None:
    q = torch.randn(50, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    q[0], q[1] = torch.tensor([0.0, 1, 0, 0]), torch.tensor([0.0, 0, -1, 0])
    assert torch.allclose(rotation(quaternions(rotation(q))), rotation(q), atol=1e-14)


def test_the_area_is_the_root_mean_square_over_all_directions() -> None:
    covariances = moments_of(some_gaussians(20, 0)).shapes.covariances
    full = _full(covariances)
    directions = torch.nn.functional.normalize(
        torch.randn(200_000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)), dim=1
    )
    adjugates = torch.linalg.inv(full) * torch.linalg.det(full)[:, None, None]
    squares = math.pi**2 * torch.einsum("di,nij,dj->nd", directions, adjugates, directions)
    assert torch.allclose(areas(covariances), squares.mean(1).sqrt(), rtol=0.01)


def test_the_moments_of_a_pair_are_those_of_its_samples() -> None:
    scene = some_gaussians(2, 1, seed=3)
    pair = moments_of(scene)
    union = merged(pair, torch.tensor([0]), torch.tensor([1]))
    assert union.count == 1
    shares = pair.shapes.masses / pair.shapes.masses.sum()
    mean = (shares[:, None] * pair.shapes.means).sum(0)
    apart = pair.shapes.means - mean
    within = (shares[:, None, None] * _full(pair.shapes.covariances)).sum(0)
    between = (shares[:, None, None] * apart[:, :, None] * apart[:, None, :]).sum(0)
    assert torch.allclose(union.shapes.masses[0], pair.shapes.masses.sum())
    assert torch.allclose(union.shapes.means[0], mean)
    assert torch.allclose(_full(union.shapes.covariances)[0], within + between)
    assert torch.allclose(union.sh[0], (shares[:, None].float() * pair.sh).sum(0), atol=1e-6)
    assert torch.allclose(union.spreads[0], (shares * apart.square().sum(1)).sum())


def test_rows_that_are_not_merged_stay_before_those_that_are() -> None:
    five = moments_of(some_gaussians(5, 0))
    after = merged(five, torch.tensor([1]), torch.tensor([3]))
    assert torch.equal(after.shapes.means[:3], five.shapes.means[[0, 2, 4]])
    assert after.count == 4
    assert torch.allclose(after.shapes.masses.sum(), five.shapes.masses.sum())


def test_an_opacity_is_the_mass_over_the_area_and_ends_under_one() -> None:
    scene = some_gaussians(2, 0)
    scene.means[1], scene.log_scales[1], scene.quats[1] = scene.means[0], scene.log_scales[0], scene.quats[0]
    scene.logit_opacities[:] = torch.logit(torch.tensor([0.2, 0.3]))
    both = (torch.tensor([0]), torch.tensor([1]))
    opacity = torch.sigmoid(gaussians_of(merged(moments_of(scene), *both)).logit_opacities)
    assert torch.allclose(opacity, torch.tensor([0.5]), atol=1e-5)
    scene.logit_opacities[:] = torch.logit(torch.tensor([0.9, 0.8]))
    opacity = torch.sigmoid(gaussians_of(merged(moments_of(scene), *both)).logit_opacities)
    assert torch.allclose(opacity, torch.tensor([moments.MOST_OPAQUE]), atol=1e-5)


def test_flat_gaussians_have_an_area_and_axes() -> None:
    scene = some_gaussians(100, 0)
    scene.log_scales[:, 2] = -25
    back = gaussians_of(moments_of(scene))
    assert bool(back.finite().all())
    assert torch.allclose(extents(back), extents(scene), rtol=1e-4)
    assert differences(back, scene)["opacities"] < 1e-5
