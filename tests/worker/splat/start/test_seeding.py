"""Proves that Gaussians in gaps and on the far shell are added within the limit, and which stay above it.

Does not prove where they are put: test_gaps and test_far_shell do.
"""

from __future__ import annotations

import pytest
import torch

from splatmill_worker.splat.start import far_shell, gaps, seeding
from splatmill_worker.splat.start.cells import cells_of
from splatmill_worker.splat.start.points import from_points
from tests.support.training import sparse_scene


@pytest.mark.slow
def test_what_is_added_keeps_to_the_limit_and_to_what_the_plan_says() -> None:
    world, views = sparse_scene()
    first = from_points(torch.from_numpy(world.points), torch.from_numpy(world.colors))
    nothing = seeding.add_seeds(
        first, world, views, fill_gaps=False, add_far_shell=False, max_gaussians=10**6
    )
    assert nothing is first
    count = len(gaps.gap_points(cells_of(world, views))[0])
    parts: list[str] = []
    whole = seeding.add_seeds(
        first, world, views, fill_gaps=True, add_far_shell=False, max_gaussians=10**6, tell=parts.append
    )
    assert parts == ["filling gaps between the points"]
    assert whole.count == first.count + count
    assert bool(whole.finite().all())
    cells = cells_of(world, views)
    seeds = seeding.Seeds(far_shell.shell_points(cells, world.points), gaps.gap_points(cells))
    both = [
        seeding.add_seeds(
            first, world, photos, seeds=known, fill_gaps=True, add_far_shell=True, max_gaussians=10**6
        )
        for photos, known in ((views, None), ([], seeds))
    ]
    for name, value in both[0].parameters().items():
        assert torch.equal(value, both[1].parameters()[name])
    most = first.count + 10
    limited = seeding.add_seeds(first, world, views, fill_gaps=True, add_far_shell=True, max_gaussians=most)
    assert limited.count == most


def test_what_exceeds_the_limit_is_left_out_in_the_gaps_first() -> None:
    world, views = sparse_scene()
    first = from_points(torch.from_numpy(world.points), torch.from_numpy(world.colors))
    shell = len(far_shell.shell_points(cells_of(world, views), world.points)[0])
    limited = seeding.add_seeds(
        first, world, views, fill_gaps=True, add_far_shell=True, max_gaussians=first.count + shell
    )
    assert limited.count == first.count + shell
    opacities = torch.sigmoid(limited.logit_opacities[first.count :])
    assert torch.allclose(opacities, torch.tensor(far_shell.OPACITY))


def test_the_most_opaque_gaussians_stay_in_their_order() -> None:
    world, _ = sparse_scene()
    first = from_points(torch.from_numpy(world.points), torch.from_numpy(world.colors))
    first.logit_opacities.copy_(torch.linspace(-1.0, 1.0, first.count).roll(3))
    kept = first.most_opaque(5)
    assert torch.equal(
        kept.logit_opacities, first.logit_opacities[[0, 1, 2, first.count - 2, first.count - 1]]
    )
    assert first.most_opaque(first.count) is first
