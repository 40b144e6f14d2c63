"""Proves which leaves a view has, and which levels are drawn: by distance, within what is allowed.

Does not prove what the errors of levels are (test_levels.py), nor how the picture looks (test_leveled_model.py).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from splatmill_worker.scene import Camera, viewmat_of
from splatmill_worker.splat.lod.boxes import leaf_boxes
from splatmill_worker.splat.lod.choice import Leaves, choose, in_view
from splatmill_worker.splat.lod.levels import make_levels
from splatmill_worker.splat.render import binned
from tests.support.gaussians import some_gaussians

AHEAD = Camera(200, 100, 100.0, 100.0, 100.0, 50.0, np.eye(4))


def boxes(*middles: tuple[float, float, float], half: float = 0.5) -> Leaves:
    """Leaves of three levels with 1000, 250 and 62 Gaussians and errors of 0, 0.01 and 0.1."""
    points = np.array(middles)
    return Leaves(
        points - half,
        points + half,
        np.tile([0.0, 0.01, 0.1], (len(points), 1)),
        np.tile([1000, 250, 62], (len(points), 1)),
    )


def test_the_level_is_that_whose_error_is_within_the_tolerance() -> None:
    """An error of 0.01 is 0.25 pixels at a distance of 4, one of 0.1 at 40; boxes begin half a unit nearer."""
    leaves = boxes((0, 0, 2), (0, 0, 4.4), (0, 0, 4.6), (0, 0, 40.4), (0, 0, 40.6), (0, 0, -4))
    choice = choose(leaves, AHEAD, 10_000, 0.25)
    assert choice.levels.tolist() == [0, 0, 1, 1, 2, -1]
    assert choice.tolerance == 0.25


@pytest.mark.parametrize("most", [2000, 1312, 1311, 600, 186])
def test_the_tolerance_is_doubled_until_no_more_gaussians_are_drawn_than_are_allowed(most: int) -> None:
    leaves = boxes((0, 0, 2), (0, 0, 5), (0, 0, 50))
    choice = choose(leaves, AHEAD, most, 0.25)
    assert leaves.counts[range(3), choice.levels].sum() <= most
    if choice.tolerance > 0.25:
        finer = choose(leaves, AHEAD, 10**9, choice.tolerance / 2)
        assert leaves.counts[range(3), finer.levels].sum() > most
    assert (choice.tolerance == 0.25) == (most >= 1312)


def test_where_nothing_is_allowed_all_have_the_coarsest_level() -> None:
    leaves = boxes((0, 0, 0), (0, 0, 5))
    choice = choose(leaves, AHEAD, 0, 0.25)
    assert choice.levels.tolist() == [2, 2]
    assert choice.tolerance == 128.0, "an error of 0.1 at 0.05 diagonals of the box is 115 pixels"


def test_in_a_leaf_the_finest_level_is_drawn() -> None:
    assert choose(boxes((0, 0, 0)), AHEAD, 10**6).levels.tolist() == [0]


def test_errors_that_fall_or_begin_above_none_leave_no_hole() -> None:
    leaves = replace(boxes((0, 0, 1), (0, 0, 5)), errors=np.array([[0.5, 0.2, 0.1], [-1.0, 0.5, 0.01]]))
    assert choose(leaves, AHEAD, 10**6).levels.tolist() == [0, 0]


@pytest.mark.parametrize("size", [1e-29, 1e29])
def test_extreme_scenes_have_a_choice(size: float) -> None:
    leaves = boxes((0, 0, 5))
    leaves = Leaves(leaves.low * size, leaves.high * size, leaves.errors * 1e29, leaves.counts)
    with np.errstate(all="raise"):
        assert choose(leaves, AHEAD, 0).levels.tolist() == [2]


def test_what_projects_into_the_picture_is_in_view() -> None:
    """Against the kernels, for cameras in and around the model: no leaf that has a Gaussian in the picture is left out,
    and leaves are."""
    levels = make_levels(some_gaussians(4000, 0), coarsest=4000, leaf=60)
    low, high = leaf_boxes(levels.levels).numpy()
    gaussians, runs = levels.levels[0].gaussians, levels.levels[0].runs
    leaf = torch.repeat_interleave(torch.arange(len(runs)), torch.tensor([run.count for run in runs]))
    leaves = Leaves(low, high, np.zeros((len(runs), 1)), np.array([[run.count] for run in runs]))
    shares = []
    for seed in range(12):
        generator = np.random.default_rng(seed)
        rotation = np.linalg.qr(generator.normal(size=(3, 3)))[0]
        rotation *= np.sign(np.linalg.det(rotation))
        camera = Camera(90, 60, 80.0, 70.0, 50.0, 20.0, viewmat_of(rotation, generator.normal(size=3)))
        _, bins = binned(gaussians, camera)
        shown = in_view(leaves, camera)
        needed = leaf[bins.ids.long()].unique().numpy()
        assert shown[needed].all()
        shares.append(shown.mean())
    assert np.mean(shares) < 0.7
