"""Reads the points of laser scanners and depth cameras into arrays: LAS, LAZ, E57, PCD, text and .ply.

It runs in a process of its own: see `images.decoding.decoders.call_once`. The libraries of the formats are the extra
`scans`, and each is imported for its own format only.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib.util import find_spec
from itertools import islice
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatmill_worker.readers import point_file, reader_memory
from splatmill_worker.wording import plain

Points = tuple[npt.NDArray[np.float64], npt.NDArray[np.uint8]]

MOST = 1_000_000
"""Points that are kept of a file: of more, every second, third and so on. A scan of a room has a hundred million."""

CHUNK = 1_000_000
"""Points of a LAS file that are read at once."""

LIBRARIES = {".las": ("laspy",), ".laz": ("laspy", "lazrs"), ".e57": ("pye57",), ".pcd": ("pypcd4",)}
"""The modules that read a format, by its suffix."""

IN_METRES = (".e57",)
"""Formats whose coordinates are metres by their standard (ASTM E2807); those of the others may be anything."""

POINT_BYTES = 200
"""Bytes that a point takes at the peak of reading in formats that are read whole."""

_SEPARATORS = re.compile(r"[,;\s]+")


def lacking(path: Path) -> str | None:
    """The first module that reading the file needs and that is not installed."""
    return next((name for name in LIBRARIES.get(path.suffix.lower(), ()) if find_spec(name) is None), None)


def read(path: Path) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.uint8], int]:
    """Positions [N,3] and colours [N,3] of at most MOST points with finite coordinates, and the number in the file.

    Positions keep the offset of the file, such as that of UTM coordinates. Points are grey where it has no colours.

    Raises ValueError for a file that cannot be read, and OSError.
    """
    suffix = path.suffix.lower()
    reader = {".las": _las, ".laz": _las, ".e57": _e57, ".pcd": _pcd, ".ply": _ply}.get(suffix, _text)
    try:
        points, colors, count = reader(path)
    except OSError:
        raise
    except Exception as error:  # the libraries raise errors of many kinds for files that are damaged
        raise ValueError(plain(error) or type(error).__name__) from error
    if points.shape != colors.shape or points.shape[1:] != (3,):
        raise ValueError(f"its {len(points)} points and {len(colors)} colours do not belong together")
    finite = np.isfinite(points).all(axis=1)
    return points[finite], colors[finite], count


def _stride(count: int) -> int:
    return max(1, -(-count // MOST))


def _las(path: Path) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.uint8], int]:
    import laspy

    points, channels = [], []
    with laspy.open(path) as reader:
        count = int(reader.header.point_count)
        colored = {"red", "green", "blue"} <= set(reader.header.point_format.dimension_names)
        stride, read_so_far = _stride(count), 0
        for chunk in reader.chunk_iterator(CHUNK):
            kept = slice(-read_so_far % stride, None, stride)
            points.append(np.stack([np.asarray(chunk[axis])[kept] for axis in "xyz"], axis=1))
            if colored:
                channels.append([np.asarray(chunk[name])[kept] for name in ("red", "green", "blue")])
            read_so_far += len(chunk)
    if read_so_far < count:
        raise ValueError(f"it ends after {read_so_far} of its {count} points")
    positions = np.concatenate([np.zeros((0, 3)), *points])
    if not channels:
        return positions, point_file.grey(len(positions)), count
    return (
        positions,
        point_file.eight_bits([np.concatenate(each) for each in zip(*channels, strict=True)]),
        count,
    )


def _e57(path: Path) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.uint8], int]:
    import pye57

    file = pye57.E57(str(path))
    try:
        headers = [file.get_header(index) for index in range(file.scan_count)]
        counts = [int(header.point_count) for header in headers]
        stride = _stride(sum(counts))
        points, colors = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)]
        for index, (header, count) in enumerate(zip(headers, counts, strict=True)):
            reader_memory.check(f"reading its {count:,} points", POINT_BYTES * count, path.stat().st_size)
            colored = "colorRed" in header.point_fields
            scan = file.read_scan(
                index, colors=colored, ignore_missing_fields=True
            )  # in the world of all scans
            points.append(np.stack([scan[f"cartesian{axis}"][::stride] for axis in "XYZ"], axis=1))
            channels = (
                [scan[f"color{name}"][::stride] for name in ("Red", "Green", "Blue")] if colored else []
            )
            colors.append(point_file.eight_bits(channels) if colored else point_file.grey(len(points[-1])))
    finally:
        file.close()
    return np.concatenate(points), np.concatenate(colors), sum(counts)


def _pcd(path: Path) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.uint8], int]:
    from pypcd4 import MetaData, PointCloud

    with path.open("rb") as file:
        metadata = MetaData.parse_header([line.decode("utf-8", "replace") for line in _pcd_header(file)])
    count = int(metadata.points)
    reader_memory.check(f"reading its {count:,} points", POINT_BYTES * count, path.stat().st_size)
    cloud = PointCloud.from_path(path)
    kept = slice(None, None, _stride(count))
    points = np.stack([np.asarray(cloud.pc_data[axis][kept], np.float64) for axis in "xyz"], axis=1)
    packed = next((name for name in ("rgb", "rgba") if name in cloud.fields), None)
    if packed is None:
        return points, point_file.grey(len(points)), count
    # Red, green and blue are the three low bytes of 32 bits, which old files give the type of a float.
    bits = np.ascontiguousarray(cloud.pc_data[packed][kept])
    integers = bits.view(np.uint32) if bits.dtype == np.float32 else bits.astype(np.uint32)
    return points, np.stack([integers >> shift & 255 for shift in (16, 8, 0)], axis=1).astype(np.uint8), count


def _pcd_header(lines: Iterator[bytes]) -> Iterator[bytes]:
    for line in islice(lines, 64):
        yield line
        if line.startswith(b"DATA"):
            return
    raise ValueError("its header has no line that begins with DATA")


def _ply(path: Path) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.uint8], int]:
    points, colors = point_file.read(path)
    kept = slice(None, None, _stride(len(points)))
    return points[kept], colors[kept], len(points)


def _text(path: Path) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.uint8], int]:
    """A point a line: x, y, z; an intensity where there are four or seven columns; red, green and blue."""
    size = path.stat().st_size
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        first = next(
            (line for line in file if _numbers(line) is not None and len(_numbers(line) or ()) >= 3), ""
        )
        rest = sum(1 for _ in file)
    columns = _numbers(first)
    if columns is None:
        raise ValueError(
            "none of its lines is a point: x, y and z, and red, green and blue where it has them"
        )
    count = rest + 1
    reader_memory.check(f"reading about {count:,} points", POINT_BYTES * min(count, MOST), size)
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        rows = (_numbers(line) for line in islice(file, 0, None, _stride(count)))
        table = np.array([row for row in rows if row is not None and len(row) == len(columns)], np.float64)
    points = table[:, :3]
    channels = table[:, {6: 3, 7: 4}.get(len(columns), len(columns)) :][:, :3]
    if channels.shape[1] < 3 or (channels < 0).any():  # without colours, or with normals in their place
        return points, point_file.grey(len(points)), count
    return points, point_file.eight_bits(list(channels.T)), count


def _numbers(line: str) -> list[float] | None:
    """The numbers of a line; None for a comment, a heading, an empty line."""
    try:
        return [float(word) for word in _SEPARATORS.split(line.strip()) if word] or None
    except ValueError:
        return None
