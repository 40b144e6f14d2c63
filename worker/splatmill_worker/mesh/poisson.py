"""The surface through points with normals: COLMAP's screened Poisson reconstruction (Kazhdan & Hoppe 2013).

It closes what no point confirms by smooth surfaces. Where the points are too far away, these are cut away again.
"""

from __future__ import annotations

import math
import tempfile
from itertools import product
from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData, PlyElement
from torch import Tensor

from splatmill_worker.mesh import ply
from splatmill_worker.mesh.samples import Samples
from splatmill_worker.mesh.triangles import Mesh

SCALE = 1.1
"""Side of the reconstruction's cube, in extents of the points."""

DEEPEST = 11
"""Most levels of the octree: cells of a two-thousandth of the cube."""

NEAR = 4.0
"""How far from a point surface may lie, in sides of the finest cells; larger holes stay open (decisions: NEAR)."""

TRIM = 3
"""Levels above the finest one at which surface is cut away: points there lie eight times as far apart. COLMAP's default
is 10 whatever the depth, and removes every face of a reconstruction of no more levels."""


class TooFine(Exception):
    """The points reach too far for cells of the size asked for."""


def levels(samples: Samples, cell: float, *, exact: bool) -> int:
    """Levels of the octree whose finest cells have at most the side `cell`, world units; DEEPEST at most.

    Raises TooFine where more are needed for an exact cell.
    """
    needed = math.ceil(math.log2(max(2.0, side_of(samples, 0) / cell)))
    if exact and needed > DEEPEST:
        raise TooFine(
            f"Voxels of {cell:.4g} are too small for what the cameras see: "
            f"{side_of(samples, DEEPEST):.4g} is the least."
        )
    return min(needed, DEEPEST)


def side_of(samples: Samples, depth: int) -> float:
    """The side of the cells that are `depth` levels below the cube, world units."""
    extent = (samples.points.amax(0) - samples.points.amin(0)).max()
    return SCALE * float(extent) / (1 << depth)


def reconstruct(samples: Samples, depth: int, trim: int = TRIM) -> Mesh:
    """The surface through the samples, without colours; faces are counter-clockwise seen from outside.

    depth: levels of the octree.
    """
    from splatmill_worker.colmap import pycolmap  # not before a mesh is made

    names = ("x", "y", "z", "nx", "ny", "nz")
    rows = np.empty(len(samples.points), [(name, "<f4") for name in names])
    columns = [*samples.points.T.numpy(), *samples.normals.T.numpy()]
    for name, column in zip(names, columns, strict=True):
        rows[name] = column
    with tempfile.TemporaryDirectory(prefix="splatmill-mesh-") as folder:
        source, target = Path(folder) / "points.ply", Path(folder) / "mesh.ply"
        PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(source))
        options = pycolmap.PoissonMeshingOptions()
        options.depth, options.trim, options.color = depth, max(1, depth - trim), False
        pycolmap.poisson_meshing(source, target, options)
        return _near(Mesh(*ply.read(target)), samples, NEAR * side_of(samples, depth))


def _near(mesh: Mesh, samples: Samples, distance: float) -> Mesh:
    """The faces whose vertices lie in a cube with the side `distance` that holds a sample, or in a neighbour of one."""
    origin = samples.points.amin(0) - 2 * distance
    occupied = torch.unique(_keys(samples.points - origin, distance))
    vertices = torch.from_numpy(mesh.vertices) - origin
    kept = torch.zeros(len(vertices), dtype=torch.bool)
    for step in product((-1.0, 0.0, 1.0), repeat=3):
        keys = _keys(vertices + distance * torch.tensor(step), distance)
        kept |= occupied[torch.searchsorted(occupied, keys).clamp_max(len(occupied) - 1)] == keys
    return mesh.only(np.asarray(kept.numpy()[mesh.faces].all(1)))


def _keys(places: Tensor, side: float) -> Tensor:
    """A number for the cube with the side `side` of each place [n, 3]."""
    x, y, z = (places / side).floor().long().unbind(1)
    return (x << 40) + (y << 20) + z
