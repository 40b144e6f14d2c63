"""The Morton order is a permutation that brings neighbours together. What it gains in time is not asserted here."""

from __future__ import annotations

import pytest
import torch

from splatmill_worker.kernels.cpu.order import morton_order


def test_neighbours_come_together() -> None:
    means = torch.rand(5000, 3, generator=torch.Generator().manual_seed(0))
    order = morton_order(means)
    assert torch.equal(order.sort().values, torch.arange(5000))
    before = (means[1:] - means[:-1]).norm(dim=1).mean()
    after = (means[order][1:] - means[order][:-1]).norm(dim=1).mean()
    assert after < 0.2 * before
    # The eight corners of a cube, in the order of the bits z y x.
    corners = torch.tensor(
        [[float(i & 1), float(i >> 1 & 1), float(i >> 2)] for i in (5, 2, 7, 0, 6, 1, 4, 3)]
    )
    assert morton_order(corners).tolist() == [3, 5, 1, 7, 6, 0, 4, 2]


@pytest.mark.parametrize("means", [torch.zeros(0, 3), torch.ones(7, 3), torch.full((4, 3), float("nan"))])
def test_degenerate_scenes_keep_their_order(means: torch.Tensor) -> None:
    assert torch.equal(morton_order(means), torch.arange(len(means)))
