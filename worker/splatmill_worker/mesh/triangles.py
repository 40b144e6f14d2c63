"""Triangle meshes: the type, the pieces that hang together, and fewer triangles for the same surface."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatmill_worker.mesh import ply

Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int32]


@dataclass(frozen=True)
class Mesh:
    """Triangles with colours, or with a texture.

    vertices: [V, 3] float32, world units.
    faces: [F, 3] int32 indices of vertices, counter-clockwise seen from outside.
    colors: [V, 3] uint8; None before they are measured, and with a texture.
    uvs: [V, 2] float32, where the vertices lie on the texture: its first row is at 0, its last at 1.
    texture: [H, W, 3] uint8.
    """

    vertices: Floats
    faces: Ints
    colors: npt.NDArray[np.uint8] | None = None
    uvs: Floats | None = None
    texture: npt.NDArray[np.uint8] | None = None

    def only(self, kept: npt.NDArray[np.bool_]) -> Mesh:
        """The faces of a mask [F], with the vertices that they use."""
        used, faces = np.unique(self.faces[kept], return_inverse=True)
        colors = None if self.colors is None else self.colors[used]
        return Mesh(self.vertices[used], faces.reshape(-1, 3).astype(np.int32), colors)

    def areas(self) -> npt.NDArray[np.float64]:
        """The area of each face [F], square world units."""
        doubled = np.linalg.norm(self._crosses(), axis=1)
        areas: npt.NDArray[np.float64] = 0.5 * doubled
        return areas

    def normals(self) -> Floats:
        """Unit normals of the vertices [V, 3]: the mean of their faces', by area. 0 of a vertex without area."""
        sums = np.zeros((len(self.vertices), 3))
        for corner in range(3):
            for axis, cross in enumerate(self._crosses().T):
                sums[:, axis] += np.bincount(self.faces[:, corner], cross, len(sums))
        lengths = np.linalg.norm(sums, axis=1, keepdims=True)
        normals: Floats = (sums / np.maximum(lengths, 1e-30)).astype(np.float32)
        return normals

    def _crosses(self) -> npt.NDArray[np.float64]:
        a, b, c = (self.vertices[self.faces[:, corner]].astype(np.float64) for corner in range(3))
        return np.cross(b - a, c - a)


def without_specks(mesh: Mesh, share: float) -> Mesh:
    """The mesh without the pieces that have less than `share` of the area of the largest one."""
    if not len(mesh.faces):
        return mesh
    piece = _pieces(mesh)[mesh.faces[:, 0]]
    area = np.bincount(piece, mesh.areas())
    return mesh.only(area[piece] >= share * area.max())


def simplified(mesh: Mesh, faces: int) -> Mesh:
    """The mesh with about `faces` triangles, by quadric error (Garland & Heckbert 1997); as it is if it has no more.

    The fewer ones have no colours: COLMAP writes none.
    """
    if len(mesh.faces) <= faces:
        return mesh
    from splatmill_worker.colmap import pycolmap  # not before a mesh is simplified

    with tempfile.TemporaryDirectory(prefix="splatmill-mesh-") as folder:
        source, target = Path(folder) / "all.ply", Path(folder) / "fewer.ply"
        ply.write(source, mesh.vertices, mesh.faces, None)
        options = pycolmap.MeshSimplificationOptions()
        options.target_face_ratio = faces / len(mesh.faces)
        pycolmap.simplify_mesh(source, target, options)
        return Mesh(*ply.read(target))


def _pieces(mesh: Mesh) -> npt.NDArray[np.int64]:
    """A number for each vertex [V], the same for all vertices that faces connect: its smallest vertex."""
    label = np.arange(len(mesh.vertices))
    while True:
        least = label[mesh.faces].min(axis=1)
        before = label.copy()
        for corner in range(3):
            np.minimum.at(label, label[mesh.faces[:, corner]], least)
        while not np.array_equal(further := label[label], label):
            label = further
        if np.array_equal(before, label):
            return label
