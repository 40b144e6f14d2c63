"""Reads the points of a `.ply` file into arrays, in a process of its own: see `images.decoding.decoders.call_once`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from plyfile import PlyElement, PlyParseError

from splatmill_worker.readers import ply_document, reader_memory
from splatmill_worker.wording import plain

POINT_BYTES = 150
"""Bytes that reading takes a point at its peak: two copies of the position in float64, and the file."""

CHANNELS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
"""Names of the properties with colours, as programs write them."""

GREY = 128
"""The channels of points without colours."""


def read(path: Path) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.uint8]]:
    """Positions [N,3] and colours [N,3] of the vertices with finite coordinates; grey where the file has no colours.

    Raises ValueError for a file that cannot be read, and OSError.
    """
    try:
        vertex = ply_document.read(path, "vertex")["vertex"]
        reader_memory.check(
            f"reading its {vertex.count:,} points", POINT_BYTES * vertex.count, path.stat().st_size
        )
        points = np.stack([np.asarray(vertex[axis], np.float64) for axis in "xyz"], axis=1)
    except (PlyParseError, KeyError, IndexError) as error:
        raise ValueError(plain(error)) from error
    colors = _colors(vertex)
    finite = np.isfinite(points).all(axis=1)
    return points[finite], colors[finite]


def _colors(vertex: PlyElement) -> npt.NDArray[np.uint8]:
    names = {each.name for each in vertex.properties}
    channels = next((each for each in CHANNELS if names.issuperset(each)), None)
    if channels is None:
        return grey(vertex.count)
    return eight_bits([vertex[channel] for channel in channels])


def grey(count: int) -> npt.NDArray[np.uint8]:
    """Colours [count,3] of points that have none."""
    return np.full((count, 3), GREY, np.uint8)


def eight_bits(channels: Sequence[npt.NDArray[Any]]) -> npt.NDArray[np.uint8]:
    """Colours [N,3] of 8 bits: channels reach up to 1, 255 or 65535, whichever the largest value needs."""
    values = [np.nan_to_num(channel, posinf=0, neginf=0) for channel in channels]
    colors = grey(len(values[0]))
    if not len(colors):
        return colors
    largest = max(float(value.max()) for value in values)
    floats = any(value.dtype.kind == "f" for value in values)
    full = 1.0 if floats and largest <= 1 else 255.0 if largest <= 255 else 65535.0
    for index, value in enumerate(values):
        colors[:, index] = np.clip(np.round(value * np.float32(255 / full)), 0, 255)
    return colors
