"""The surface through points of known places: in its place, outward, open where no points are; and its levels."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splatmill_worker.mesh.poisson import DEEPEST, TooFine, levels, reconstruct, side_of
from splatmill_worker.mesh.samples import Samples
from splatmill_worker.mesh.triangles import Mesh

RADIUS = 0.8


def ball(count: int = 6000, lowest: float = -1.0) -> Samples:
    """Points on a ball around the origin, without those whose z is below a share of the radius."""
    random = np.random.default_rng(0)
    directions = random.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    normals = torch.tensor(directions[directions[:, 2] >= lowest], dtype=torch.float32)
    return Samples(RADIUS * normals, normals)


def open_edges(mesh: Mesh) -> int:
    """The number of edges at which there is one face alone."""
    pairs = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    _, counts = np.unique(np.sort(pairs, axis=1), axis=0, return_counts=True)
    return int((counts == 1).sum())


def test_a_ball_is_closed_and_round() -> None:
    mesh = reconstruct(ball(), 6)
    radii = np.linalg.norm(mesh.vertices, axis=1)
    assert np.abs(radii - RADIUS).max() < 0.01
    assert open_edges(mesh) == 0
    assert ((mesh.normals() * mesh.vertices).sum(1) / radii > 0.98).all()


def test_nothing_is_closed_where_no_points_are() -> None:
    mesh = reconstruct(ball(lowest=-0.2), 6)
    assert open_edges(mesh) > 50
    assert mesh.vertices[:, 2].max() > 0.97 * RADIUS
    assert mesh.vertices[:, 2].min() > -0.2 * RADIUS - 8 * side_of(ball(), 6)


def test_a_hole_between_points_is_closed() -> None:
    whole = ball(20_000)
    near = torch.linalg.vector_norm(whole.points - torch.tensor([0.0, 0.0, RADIUS]), dim=1) < 0.06
    mesh = reconstruct(Samples(whole.points[~near], whole.normals[~near]), 6)
    assert open_edges(mesh) == 0


def test_levels_follow_the_cells_that_are_asked_for() -> None:
    samples = ball()
    depth = levels(samples, 0.05, exact=True)
    assert 0.025 < side_of(samples, depth) <= 0.05
    assert levels(samples, 1e-30, exact=False) == DEEPEST
    assert levels(samples, 1e30, exact=False) == 1
    with pytest.raises(TooFine, match="is the least"):
        levels(samples, 1e-30, exact=True)
