"""Triangles of the zero level of a field: one vertex in each cell that it crosses (Gibson 1998, surface nets).

A cell is the cube between eight neighbouring voxels. Its vertex is the mean of the points where the field changes its
sign along the cell's edges; each such edge joins the vertices of the four cells around it by two triangles.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np
import torch
from torch import Tensor

from splatmill_worker.mesh.fusion import SIDE, Field, key_of
from splatmill_worker.mesh.triangles import Mesh

LEAST_VIEWS = 2.0
"""Views that must have seen each voxel of a cell that the surface crosses."""

AT_ONCE = 4096
"""Blocks whose cells are examined at a time."""

CORNERS = tuple(product((0, 1), repeat=3))
"""Of a cell, as offsets from its first voxel."""

EDGES = tuple(
    (a, b)
    for a, b in product(range(8), repeat=2)
    if sum(abs(x - y) for x, y in zip(CORNERS[a], CORNERS[b], strict=True)) == 1 and a < b
)
"""Of a cell, as numbers of its corners."""


def extract(field: Field) -> Mesh:
    """The surface of a field, without colours; faces are counter-clockwise seen from outside."""
    cells, vertices, crossings = [], [], []
    padded = _with_neighbours(field)
    for first in range(0, len(field.blocks), AT_ONCE):
        part = slice(first, first + AT_ONCE)
        values = padded(part)
        active, corners = _active(values)
        numbers = active.nonzero()
        found = corners[:, *numbers.T]  # [8, n]
        place = field.blocks[part][numbers[:, 0]] * SIDE + numbers[:, 1:]
        cells.append(key_of(place))
        vertices.append(place + _vertex(found))
        crossings.append(found[[0, 4, 2, 1]] < 0)  # at the cell's first voxel, and one on along x, y and z
    keys, order = torch.sort(torch.cat(cells))
    place = torch.cat(vertices)[order] * field.voxel + field.origin
    signs = torch.cat(crossings, 1)[:, order]
    faces = _faces(keys, signs, place)
    return Mesh(place.float().numpy(), faces.numpy().astype(np.int32))


def _with_neighbours(field: Field) -> Callable[[slice], Tensor]:
    """A function from a part of the blocks to what `padded` returns of them."""
    keys = key_of(field.blocks)
    unknown = torch.full((1, SIDE, SIDE, SIDE), torch.nan)
    seen = torch.where(field.weights >= LEAST_VIEWS, field.distances, torch.nan)
    every = torch.cat([seen, unknown])

    def padded(part: slice) -> Tensor:
        """Distances [n, 9, 9, 9] of blocks with the first voxels of those after them; NaN where they are unknown."""
        blocks = field.blocks[part]
        whole = torch.full((len(blocks), SIDE + 1, SIDE + 1, SIDE + 1), torch.nan)
        for corner in CORNERS:
            wanted = key_of(blocks + torch.tensor(corner))
            at = torch.searchsorted(keys, wanted).clamp_max(len(keys) - 1)
            rows = torch.where(keys[at] == wanted, at, len(keys))
            target = tuple(slice(SIDE, None) if c else slice(0, SIDE) for c in corner)
            source = tuple(slice(0, 1) if c else slice(None) for c in corner)
            whole[:, *target] = every[rows][:, *source]
        return whole

    return padded


def _active(values: Tensor) -> tuple[Tensor, Tensor]:
    """Which cells [n, 8, 8, 8] the surface crosses, and the values [8, n, 8, 8, 8] at their corners."""
    corners = torch.stack([values[:, *(slice(c, SIDE + c) for c in corner)] for corner in CORNERS])
    inside = (corners < 0).sum(0)
    known = torch.isfinite(corners).all(0)
    return known & (inside > 0) & (inside < 8), corners


def _vertex(values: Tensor) -> Tensor:
    """Mean of the points where the edges of cells cross zero [n, 3], from the cell's first voxel, for values [8, n]."""
    total, count = (
        values.new_zeros(values.shape[1], 3, dtype=torch.float64),
        values.new_zeros(values.shape[1]),
    )
    places = torch.tensor(CORNERS, dtype=torch.float64)
    for a, b in EDGES:
        crossed = (values[a] < 0) != (values[b] < 0)
        share = torch.where(crossed, values[a] / (values[a] - values[b]), 0.0).double()
        point = places[a] + share[:, None] * (places[b] - places[a])
        total += torch.where(crossed[:, None], point, 0.0)
        count += crossed
    return total / count[:, None]


def _faces(keys: Tensor, signs: Tensor, place: Tensor) -> Tensor:
    """Triangles [F, 3] around the edges that cross zero, for cells by sorted `keys` [n]."""
    faces = []
    units = torch.eye(3, dtype=torch.int64)
    for axis in range(3):
        # The edge from a cell's first voxel along the axis; the four cells around it, counter-clockwise from above.
        crossed = (signs[0] != signs[1 + axis]).nonzero()[:, 0]
        second, third = units[(axis + 1) % 3], units[(axis + 2) % 3]
        ring = [torch.zeros(3, dtype=torch.int64), second, second + third, third]
        corners = []
        for back in ring:
            wanted = keys[crossed] - (key_of(back) - key_of(torch.zeros_like(back)))
            at = torch.searchsorted(keys, wanted).clamp_max(len(keys) - 1)
            corners.append(torch.where(keys[at] == wanted, at, -1))
        quads = torch.stack(corners, 1)
        complete = (quads >= 0).all(1)
        quads = quads[complete]
        # Outside lies where the field is positive: towards the axis if the first voxel is inside.
        quads = torch.where(signs[0, crossed[complete]][:, None], quads, quads.flip(1))
        faces.append(_halves(quads, place))
    return torch.cat(faces)


def _halves(quads: Tensor, place: Tensor) -> Tensor:
    """Two triangles [2 n, 3] for each quad [n, 4], divided along its shorter diagonal."""
    a, b, c, d = quads.unbind(1)
    short = (place[a] - place[c]).square().sum(1) <= (place[b] - place[d]).square().sum(1)
    first = torch.where(short[:, None], torch.stack([a, b, c], 1), torch.stack([b, c, d], 1))
    second = torch.where(short[:, None], torch.stack([a, c, d], 1), torch.stack([b, d, a], 1))
    return torch.cat([first, second])
