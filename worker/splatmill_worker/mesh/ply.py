"""Meshes as `.ply`: binary, float32 vertices with 8-bit colours, triangles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from plyfile import PlyData, PlyElement

from splatmill.files import replacing

CORNERS = ("vertex_indices", "vertex_index")
"""Names of a face's list; COLMAP writes the second."""

CHANNELS = ("red", "green", "blue")


def write(
    path: Path,
    vertices: npt.NDArray[np.float32],
    faces: npt.NDArray[np.int32],
    colors: npt.NDArray[np.uint8] | None,
    comments: tuple[str, ...] = (),
) -> None:
    """Write vertices [V,3], faces [F,3] and colours [V,3]. The file is replaced atomically."""
    fields = [(axis, "<f4") for axis in "xyz"] + [(name, "u1") for name in CHANNELS if colors is not None]
    rows = np.empty(len(vertices), fields)
    for axis, column in zip("xyz", vertices.T, strict=True):
        rows[axis] = column
    if colors is not None:
        for name, column in zip(CHANNELS, colors.T, strict=True):
            rows[name] = column
    triangles = np.empty(len(faces), [(CORNERS[0], "<i4", (3,))])
    triangles[CORNERS[0]] = faces
    parts = [PlyElement.describe(rows, "vertex"), PlyElement.describe(triangles, "face")]
    with replacing(path) as part:
        PlyData(parts, comments=list(comments), byte_order="<").write(str(part))


def read(
    path: Path,
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int32], npt.NDArray[np.uint8] | None]:
    """The vertices, faces and colours of a file of triangles that this program or COLMAP has written."""
    lengths = {"face": dict.fromkeys(CORNERS, 3)}
    document = PlyData.read(str(path), known_list_len=lengths)
    rows = document["vertex"].data
    vertices = np.stack([rows[axis] for axis in "xyz"], 1).astype(np.float32)
    triangles = document["face"].data
    name = next(name for name in CORNERS if name in triangles.dtype.names)
    faces = np.asarray(triangles[name], np.int32).reshape(-1, 3)
    named = set(CHANNELS) <= set(rows.dtype.names)
    colors = np.stack([rows[name] for name in CHANNELS], 1).astype(np.uint8) if named else None
    return vertices, faces, colors
