"""Colours of a mesh's vertices, from the views that see them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from splatmill_worker.mesh.depths import AGREEMENT, View
from splatmill_worker.mesh.triangles import Mesh

SHARPEST = 4.0
"""Power of the cosine between normal and ray in a view's weight: views from the front see the most detail (decisions:
SHARPEST)."""

UNSEEN = 128
"""Grey level of vertices that no view sees and no coloured vertex is near to."""

SPREADINGS = 64
"""Rounds in which vertices without a colour take the mean of those that they share a face with."""


def colored(mesh: Mesh, views: Sequence[View]) -> Mesh:
    """The mesh with the mean colour of each vertex in the views whose depth agrees with it, by how they face it."""
    points, normals = torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.normals())
    mean, weight = blended(points, normals, views)
    colors = _spread(mesh, mean, weight > 0)
    return replace(mesh, colors=colors.round().to(torch.uint8).numpy())


def blended(points: Tensor, normals: Tensor, views: Sequence[View]) -> tuple[Tensor, Tensor]:
    """The mean colour [n, 3] of points [n, 3] with normals [n, 3] in the views whose depth agrees, by how these face
    them; and the sum of the weights [n], which is 0 where no view sees a point."""
    total, weight = torch.zeros(len(points), 3), torch.zeros(len(points))
    for view in views:
        column, row, z = view.pixels(points)
        agrees = (z > 0) & ((view.depth[row, column] - z).abs() < AGREEMENT * z)
        visible = agrees.nonzero()[:, 0]
        center = torch.as_tensor(view.camera.center).float()
        towards = torch.nn.functional.normalize(center - points[visible], dim=1)
        facing = (towards * normals[visible]).sum(1).clamp_min(0.0) ** SHARPEST
        share = facing / z[visible].square().clamp_min(1e-12)
        total[visible] += share[:, None] * view.color[row[visible], column[visible]].float()
        weight[visible] += share
    return total / weight[:, None].clamp_min(1e-30), weight


def _spread(mesh: Mesh, colors: Tensor, known: Tensor) -> Tensor:
    """Colours [V, 3] where those that are not known [V] come from their neighbours."""
    faces = mesh.faces
    values, have = colors.numpy().astype(np.float64), known.numpy().copy()
    for _ in range(SPREADINGS):
        open_faces = faces[have[faces].any(1) & ~have[faces].all(1)]
        if not len(open_faces):
            break
        sums, counts = np.zeros_like(values), np.zeros(len(values))
        for a in range(3):
            for b in range(3):
                source, target = open_faces[:, a], open_faces[:, b]
                rows = have[source] & ~have[target]
                np.add.at(sums, target[rows], values[source[rows]])
                np.add.at(counts, target[rows], 1)
        new = counts > 0
        values[new] = sums[new] / counts[new, None]
        have |= new
    values[~have] = UNSEEN
    return torch.from_numpy(values)
