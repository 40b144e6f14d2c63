"""Proves how points become Gaussians: place, width, opacity and colour, duplicates and degenerate input included.

Does not prove that training goes well from them.
"""

from __future__ import annotations

import pytest
import torch

from splatmill_worker.splat.gaussians import SH_C0
from splatmill_worker.splat.start.points import from_points, isotropic


def test_gaussians_are_as_wide_as_their_neighbours_are_far() -> None:
    grid = torch.stack(torch.meshgrid(*[torch.arange(4.0)] * 3, indexing="ij"), dim=-1).reshape(-1, 3)
    grid = torch.cat([grid, grid[:1]])  # a duplicate must not become a spike
    scene = from_points(grid, torch.full((65, 3), 255, dtype=torch.uint8))
    scales = scene.log_scales.exp()
    assert torch.allclose(scales[10:60], torch.ones(50, 3), atol=1e-5)
    assert float(scales.min()) > 0.3
    assert torch.allclose(torch.sigmoid(scene.logit_opacities), torch.tensor(0.1))
    assert torch.allclose(0.5 + SH_C0 * scene.sh[:, 0], torch.ones(65, 3))


def test_a_single_point_has_no_neighbours_to_be_as_wide_as() -> None:
    with pytest.raises(ValueError, match="two"):
        from_points(torch.zeros(1, 3), torch.zeros(1, 3, dtype=torch.uint8))


def test_isotropic_gaussians_have_one_width_no_rotation_and_one_colour() -> None:
    points = torch.tensor([[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]])
    made = isotropic(points, torch.tensor([0.5, 2.0]), torch.tensor([[255, 0, 51]] * 2, dtype=torch.uint8))
    assert torch.equal(made.means, points)
    assert torch.allclose(made.log_scales.exp(), torch.tensor([[0.5], [2.0]]).expand(2, 3))
    assert torch.equal(made.quats, torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2))
    assert torch.allclose(0.5 + SH_C0 * made.sh[:, 0], torch.tensor([1.0, 0.0, 0.2]))
    assert not made.sh[:, 1:].any()
