"""Reads the points of a `.ply` file into arrays, in a process of its own: see `images.decoders.call_once`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from plyfile import PlyData, PlyParseError

from splatmill_worker import ply_header, reader_memory

POINT_BYTES = 150
"""Bytes that reading takes a point at its peak: two copies of the position in float64, and the file."""


def read(path: Path) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.uint8]]:
    """Positions [N,3] and colours [N,3] of the vertices with finite coordinates; grey where the file has no colours.

    Raises ValueError for a file that cannot be read, and OSError.
    """
    ply_header.check(path)
    try:
        vertex = PlyData.read(str(path))["vertex"]
        reader_memory.check(
            f"reading its {vertex.count:,} points", POINT_BYTES * vertex.count, path.stat().st_size
        )
        points = np.stack([np.asarray(vertex[axis], np.float64) for axis in "xyz"], axis=1)
        channels = ("red", "green", "blue")
        if {name.name for name in vertex.properties} >= set(channels):
            colors = np.stack([np.asarray(vertex[channel], np.uint8) for channel in channels], 1)
        else:
            colors = np.full(points.shape, 128, np.uint8)
    except (PlyParseError, KeyError, IndexError) as error:
        raise ValueError(str(error)) from error
    finite = np.isfinite(points).all(axis=1)
    return points[finite], colors[finite]
