"""A texture for a mesh: charts by xatlas (Young 2018), and the colour of each texel from the views that see it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import torch

from splatmill_worker.mesh.colors import blended
from splatmill_worker.mesh.depths import View
from splatmill_worker.mesh.triangles import Mesh

PADDING = 4
"""Texels between two charts: programs show textures reduced, which mixes neighbouring texels."""

AT_ONCE = 1 << 19
"""Texels that are tried at a time; each takes about 100 bytes."""

Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int64]


def textured(mesh: Mesh, views: Sequence[View], side: int) -> Mesh:
    """The mesh with a texture in place of the colours of its vertices.

    mesh: with colours, which texels have that no view sees.
    side: longest side of the texture, in texels.
    """
    import xatlas  # not before a texture is made

    assert mesh.colors is not None
    normals = mesh.normals()
    atlas = xatlas.Atlas()
    atlas.add_mesh(mesh.vertices, mesh.faces.astype(np.uint32), normals)
    packing = xatlas.PackOptions()
    packing.resolution, packing.padding = side, PADDING
    atlas.generate(pack_options=packing)  # with the chart options of xatlas (decisions: charts)
    source, faces, uvs = atlas[0]
    scale = side / max(atlas.width, atlas.height)
    width, height = (max(1, round(scale * length)) for length in (atlas.width, atlas.height))
    points, normals, known = mesh.vertices[source], normals[source], mesh.colors[source].astype(np.float32)
    picture = np.zeros((height * width, 3), np.float32)
    covered = np.zeros(height * width, bool)
    corners = uvs * np.array([width, height], np.float32)
    for texels, face, shares in _texels(corners, faces.astype(np.int64), width, height):
        at = faces[face]
        where, direction, color = (
            np.einsum("nk,nkc->nc", shares, values[at]) for values in (points, normals, known)
        )
        blend, weight = blended(torch.from_numpy(where), torch.from_numpy(direction), views)
        picture[texels] = np.where(weight.numpy()[:, None] > 0, blend.numpy(), color)
        covered[texels] = True
    picture = _padded(picture.reshape(height, width, 3), covered.reshape(height, width))
    return replace(
        mesh,
        vertices=points,
        faces=faces.astype(np.int32),
        colors=None,
        uvs=uvs.astype(np.float32),
        texture=picture.round().astype(np.uint8),
    )


def _texels(corners: Floats, faces: Ints, width: int, height: int) -> Iterator[tuple[Ints, Ints, Floats]]:
    """Parts of the texels whose centres lie in a face: their numbers row by row, the faces, and the shares [n, 3] of
    the faces' corners.

    corners: [V, 2], in texels.
    """
    triangles = corners[faces]  # [F, 3, 2]
    low = np.floor(triangles.min(1) - 0.5).astype(np.int64).clip(0)
    high = np.ceil(triangles.max(1) + 0.5).astype(np.int64)
    spans = np.minimum(high, [width, height]) - low
    counts = spans.prod(1)
    ends = np.cumsum(counts)
    start = 0
    while start < len(faces):
        # Whole faces, at least one of them.
        end = max(start + 1, int(np.searchsorted(ends, ends[start] - counts[start] + AT_ONCE)))
        face = np.repeat(np.arange(start, end), counts[start:end])
        number = np.arange(len(face)) - np.repeat(
            ends[start:end] - counts[start:end] - (ends[start] - counts[start]), counts[start:end]
        )
        column, row = low[face, 0] + number % spans[face, 0], low[face, 1] + number // spans[face, 0]
        shares = _shares(triangles[face], column + 0.5, row + 0.5)
        inside = (shares >= 0.0).all(1)
        yield (row * width + column)[inside], face[inside], shares[inside].astype(np.float32)
        start = end


def _shares(
    triangles: Floats, x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Barycentric coordinates [n, 3] of places in triangles [n, 3, 2]; -1 in triangles without area."""
    (ax, ay), (bx, by), (cx, cy) = (triangles[:, corner].T.astype(np.float64) for corner in range(3))
    area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    flat = np.abs(area) < 1e-12
    area = np.where(flat, 1.0, area)
    b = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) / area
    c = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) / area
    return np.where(flat[:, None], -1.0, np.stack([1.0 - b - c, b, c], 1))


def _padded(picture: Floats, covered: npt.NDArray[np.bool_]) -> Floats:
    """The picture [H, W, 3] whose charts are continued by PADDING texels into what is not covered [H, W]."""
    values = np.where(covered[..., None], picture, 0.0)
    have = covered.astype(np.float32)
    for _ in range(PADDING):
        sums, counts = np.zeros_like(values), np.zeros_like(have)
        for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
            sums += np.roll(values * have[..., None], step, axis)
            counts += np.roll(have, step, axis)
        new = (have == 0) & (counts > 0)
        values[new] = sums[new] / counts[new, None]
        have[new] = 1.0
    return values
