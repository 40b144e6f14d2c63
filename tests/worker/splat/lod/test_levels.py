"""Proves the levels of a model: their numbers, what each keeps of it, their errors, and their pictures from afar.

Does not prove what levels cost a trained scene: `splatmill bench formats --only levels` measures that.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from splatmill_worker.scene import Camera
from splatmill_worker.splat.evaluate import psnr
from splatmill_worker.splat.gaussians import SH_C0, Gaussians, concatenate
from splatmill_worker.splat.lod.levels import RATIO, Levels, make_levels
from splatmill_worker.splat.lod.moments import moments_of
from splatmill_worker.splat.lod.pairing import pairs
from splatmill_worker.splat.lod.partition import partition
from splatmill_worker.splat.render import render
from tests.support.gaussians import some_gaussians


def _ball(n: int, seed: int = 0) -> Gaussians:
    """A ball of radius 1 whose surface is n flat, opaque Gaussians of colours in waves."""
    generator = torch.Generator().manual_seed(seed)
    normals = torch.nn.functional.normalize(torch.randn(n, 3, generator=generator), dim=1)
    z = torch.tensor([0.0, 0.0, 1.0])
    quats = torch.cat([1 + normals[:, 2:], torch.linalg.cross(z.expand(n, 3), normals)], 1)
    size = 1.5 * (4 * np.pi / n) ** 0.5 / 2
    scales = torch.tensor([size, size, size / 10]).log().expand(n, 3).clone()
    colors = 0.5 + 0.4 * torch.sin(5 * normals + torch.tensor([0.0, 1.0, 2.0]))
    return Gaussians(normals, scales, quats, torch.full((n,), 3.0), ((colors - 0.5) / SH_C0)[:, None])


def _camera(size: int) -> Camera:
    """A camera at distance 3 from the origin, whose picture shows the ball of radius 1."""
    viewmat = np.eye(4)
    viewmat[2, 3] = 3.0
    return Camera(size, size, 1.2 * size, 1.2 * size, size / 2, size / 2, viewmat)


def _whole(levels: Levels, number: int) -> Gaussians:
    level = levels.levels[number].gaussians
    return level if levels.surroundings is None else concatenate(level, levels.surroundings)


def test_each_level_has_a_quarter_of_the_one_before() -> None:
    scene = some_gaussians(20_000, 1)
    levels = make_levels(scene, coarsest=500, leaf=1000)
    far = 0 if levels.surroundings is None else levels.surroundings.count
    counts = [level.gaussians.count for level in levels.levels]
    assert counts[0] == scene.count - far
    assert len(counts) == 4
    for finer, coarser in itertools.pairwise(counts):
        assert coarser == pytest.approx(finer / RATIO, rel=0.02)
    assert counts[-1] <= 500
    assert len(levels.levels[0].runs) == 32
    for level in levels.levels:
        assert bool(level.gaussians.finite().all())
        assert len(level.runs) == len(level.errors) == 32
        ends = np.cumsum([run.count for run in level.runs])
        assert [run.first for run in level.runs] == [0, *ends[:-1]]
        assert ends[-1] == level.gaussians.count


def test_a_model_that_is_small_has_one_level() -> None:
    scene = some_gaussians(300, 0)
    levels = make_levels(scene)
    assert len(levels.levels) == 1
    assert _whole(levels, 0).count == 300
    none = make_levels(scene.select(torch.arange(0)))
    assert none.levels[0].gaussians.count == 0
    assert none.surroundings is None


def test_a_leaf_keeps_its_mass_and_its_middle_in_all_levels() -> None:
    scene = some_gaussians(8000, 0)
    scene.logit_opacities[:] -= 7  # so thin that no sum of opacities comes to one
    levels = make_levels(scene, coarsest=200, leaf=1000)
    sums = []
    for level in levels.levels:
        shapes = moments_of(level.gaussians).shapes
        leaf = torch.repeat_interleave(
            torch.arange(len(level.runs)), torch.tensor([run.count for run in level.runs])
        )
        mass = torch.zeros(len(level.runs), dtype=torch.float64).index_add_(0, leaf, shapes.masses)
        middle = torch.zeros(len(level.runs), 3, dtype=torch.float64)
        middle.index_add_(0, leaf, shapes.masses[:, None] * shapes.means)
        sums.append((mass, middle / mass[:, None]))
    for mass, middle in sums[1:]:
        assert torch.allclose(mass, sums[0][0], rtol=1e-4)
        assert torch.allclose(middle, sums[0][1], atol=1e-4)


def test_errors_grow_from_level_to_level_and_with_the_size_of_the_scene() -> None:
    scene = some_gaussians(8000, 0)
    errors = [level.errors for level in make_levels(scene, coarsest=200, leaf=1000).levels]
    assert set(errors[0]) == {0.0}
    for finer, coarser in itertools.pairwise(errors):
        assert all(a < b for a, b in zip(finer, coarser, strict=True))
    larger = make_levels(scene.moved(4.0, torch.zeros(3)), coarsest=200, leaf=1000).levels[-1].errors
    assert larger == pytest.approx([4 * error for error in errors[-1]], rel=1e-3)


def test_a_far_shell_is_the_surroundings_unless_it_is_large() -> None:
    scene, shell = some_gaussians(2000, 0), some_gaussians(300, 0, seed=1)
    shell.means[:] = 50 * torch.nn.functional.normalize(shell.means, dim=1)
    levels = make_levels(concatenate(scene, shell), coarsest=100)
    assert levels.surroundings is not None
    assert levels.surroundings.count == 300
    assert float(levels.surroundings.means.norm(dim=1).min()) > 49
    assert float(levels.levels[-1].gaussians.means.norm(dim=1).max()) < 10
    whole = make_levels(concatenate(scene, shell), most_surroundings=299)
    assert whole.surroundings is None
    assert whole.levels[0].gaussians.count == 2300


def test_pairs_are_of_one_leaf_and_each_row_is_in_one() -> None:
    moments = moments_of(some_gaussians(900, 0))
    groups = torch.arange(900) // 300
    first, second = pairs(moments, groups, 900, 0)
    assert 100 < len(first) <= 450
    assert len(torch.cat([first, second]).unique()) == 2 * len(first)
    assert torch.equal(groups[first], groups[second])
    few, others = pairs(moments, groups, 10, 0)
    assert len(few) == len(others) == 10
    assert {(int(a), int(b)) for a, b in zip(few, others, strict=True)} <= {
        (int(a), int(b)) for a, b in zip(first, second, strict=True)
    }


def test_neighbours_of_one_colour_are_merged_before_others() -> None:
    ball = _ball(2000)
    ball.sh[:] = torch.where(ball.means[:, :1] > 0, 1.0, -1.0)[:, None] / SH_C0 / 2  # black and white halves
    first, second = pairs(moments_of(ball), torch.zeros(2000, dtype=torch.int64), 400, 0)
    assert len(first) == 400
    assert torch.equal(ball.means[first, 0] > 0, ball.means[second, 0] > 0)


def test_leaves_are_halves_of_halves_in_space() -> None:
    means = some_gaussians(1000, 0).means
    tree, leaves = partition(means, 100)
    assert sorted(torch.cat(leaves).tolist()) == list(range(1000))
    assert {len(rows) for rows in leaves} <= {62, 63}
    assert (tree.first, tree.last) == (0, len(leaves))
    assert tree.children is not None
    sides = [torch.cat(leaves[child.first : child.last]) for child in tree.children]
    axis = int((means.amax(0) - means.amin(0)).argmax())
    assert float(means[sides[0], axis].max()) <= float(means[sides[1], axis].min())


def test_from_afar_a_coarser_level_is_the_better_picture() -> None:
    scene = _ball(16_000)
    levels = make_levels(scene, coarsest=300, leaf=4000)
    again = make_levels(scene, coarsest=300, leaf=4000)
    for one, other in zip(levels.levels, again.levels, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(one.gaussians, other.gaussians, strict=True))

    near = render(scene, _camera(512)).color.clamp(0, 1)
    scores = []
    for size in (512, 128, 32):
        # The truth from afar is the mean of what stands in each pixel: that of the near picture.
        truth = near.reshape(size, 512 // size, size, 512 // size, 3).mean((1, 3))
        shown = [
            render(_whole(levels, number), _camera(size)).color.clamp(0, 1)
            for number in range(len(levels.levels))
        ]
        scores.append([psnr(float((color - truth).double().square().mean())) for color in shown])
    # Level 0 has several Gaussians a pixel in the small pictures, each of them widened to the size of a pixel.
    assert scores[0][1] > 25
    assert scores[0][0] > scores[0][1] > scores[0][2] > scores[0][3]
    assert max(scores[1]) == scores[1][1] > 24.8
    assert max(scores[2]) == scores[2][2] > 18.4
    assert scores[2][2] > scores[2][1] > scores[2][0]
