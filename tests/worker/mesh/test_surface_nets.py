"""The surface of a field whose distances are known: closed, outward, in its place; none where nothing was seen."""

from __future__ import annotations

import math

import numpy as np
import torch

from splatmill_worker.mesh.fusion import SIDE, Field, coordinates_of, key_of
from splatmill_worker.mesh.surface_nets import extract
from splatmill_worker.mesh.triangles import Mesh

RADIUS, VOXEL = 0.8, 0.05


def ball(shift: float = 0.0) -> Field:
    """The signed distances to a sphere around the origin, in blocks that hold all of it."""
    grid = torch.cartesian_prod(*[torch.arange(-3, 3)] * 3)
    blocks = coordinates_of(torch.sort(key_of(grid)).values)
    step = torch.arange(SIDE)
    offsets = torch.stack(torch.meshgrid(step, step, step, indexing="ij"), -1)
    places = (blocks[:, None, None, None] * SIDE + offsets) * VOXEL + shift
    distances = ((places.norm(dim=-1) - RADIUS) / (4 * VOXEL)).clamp(-1, 1)
    origin = torch.full((3,), shift, dtype=torch.float64)
    return Field(origin, VOXEL, blocks, distances.float(), torch.full_like(distances, 3.0).float())


def edges(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """The edges of a mesh, and the number of faces at each."""
    pairs = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    found, counts = np.unique(np.sort(pairs, axis=1), axis=0, return_counts=True)
    return found, counts


def test_a_ball_is_closed_and_round_across_its_blocks() -> None:
    mesh = extract(ball(shift=0.013))
    radii = np.linalg.norm(mesh.vertices, axis=1)
    assert np.abs(radii - RADIUS).max() < 0.05 * VOXEL
    found, counts = edges(mesh)
    assert (counts == 2).all()
    assert len(mesh.vertices) - len(found) + len(mesh.faces) == 2  # Euler's number of a sphere
    assert math.isclose(mesh.areas().sum(), 4 * math.pi * RADIUS**2, rel_tol=5e-3)
    assert ((mesh.normals() * mesh.vertices).sum(1) / radii > 0.99).all()


def test_nothing_is_closed_where_nothing_was_seen() -> None:
    field = ball()
    places = field.blocks[:, 2] < 0
    field.weights[places] = 1.0  # a single view
    mesh = extract(field)
    assert len(mesh.faces) > 1000
    assert mesh.vertices[:, 2].min() > -0.5 * VOXEL
    _, counts = edges(mesh)
    assert (counts == 1).any()


def test_a_field_without_a_surface_has_no_faces() -> None:
    field = ball()
    field.distances.fill_(0.5)
    mesh = extract(field)
    assert mesh.vertices.shape == (0, 3)
    assert mesh.faces.shape == (0, 3)


def test_keys_sort_as_coordinates_do_and_come_back() -> None:
    coordinates = torch.tensor(
        [[-400_000, 3, 5], [-1, -1, -1], [-1, 0, 0], [0, 0, 0], [0, 0, 7], [1, -9, 400_000]]
    )
    keys = key_of(coordinates)
    assert torch.equal(torch.sort(keys).values, keys)
    assert torch.equal(coordinates_of(keys), coordinates)
