"""COLMAP models, transforms and .ply files that lie about their sizes or hold what no camera can be."""

from __future__ import annotations

import json
import struct
from typing import Any

import zstandard


def text(count: int = 3) -> dict[str, str]:
    """The files of a COLMAP model of cameras in a row, without points."""
    images = "".join(f"{k} 1 0 0 0 {k} 0 5 1 {k}.jpg\n\n" for k in range(1, count + 1))
    return {"cameras": "1 PINHOLE 64 48 60 60 32 24\n", "images": images, "points3D": "# none\n"}


def binary(count: int = 3) -> dict[str, bytes]:
    """The same model as COLMAP's binary files."""
    return {
        "cameras": struct.pack("<QIiQQ4d", 1, 1, 1, 64, 48, 60, 60, 32, 24),
        "images": struct.pack("<Q", count) + b"".join(_image(k) for k in range(1, count + 1)),
        "points3D": struct.pack("<Q", 0),
    }


def image_with_points(points: int) -> bytes:
    """images.bin with one photo that announces so many points, and has none."""
    return struct.pack("<Q", 1) + _image(1, points)


def point_with_track(length: int) -> bytes:
    """points3D.bin with one point that announces so many observations, and has none."""
    return struct.pack("<QQ3d3BdQ", 1, 1, 0.0, 0.0, 0.0, 9, 9, 9, 0.5, length)


def transforms(count: int = 3, **changes: Any) -> bytes:
    """A transforms.json of cameras in a row; `changes` are of its first frame."""
    frames: list[dict[str, Any]] = [
        {"file_path": f"{k}.jpg", "transform_matrix": matrix(float(k))} for k in range(1, count + 1)
    ]
    frames[0] |= changes
    return json.dumps({"fl_x": 60.0, "w": 64, "h": 48, "frames": frames}).encode()


def transforms_with_points() -> bytes:
    """The same, with its points in points.ply."""
    return json.dumps(json.loads(transforms()) | {"ply_file_path": "points.ply"}).encode()


def matrix(x: float) -> list[list[float]]:
    return [[1.0, 0.0, 0.0, x], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 5.0], [0.0, 0.0, 0.0, 1.0]]


SPLAT = (
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
"""Properties of a splat file of SH degree 0."""


def ply(
    count: int = 1, *, rows: int | None = None, value: float = 0.5, kind: str = "binary_little_endian"
) -> bytes:
    """A splat .ply that announces `count` Gaussians and has `rows`."""
    head = ["ply", f"format {kind} 1.0", f"element vertex {count}"]
    head += [f"property float {name}" for name in SPLAT] + ["end_header", ""]
    row = struct.pack(f"<{len(SPLAT)}f", *[value] * len(SPLAT))
    return "\n".join(head).encode() + row * (count if rows is None else rows)


def compressed_ply(*, chunks: int, count: int) -> bytes:
    """A compressed .ply of zeros."""
    axes = [f"{end}_{what}{axis}" for what in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
    head = ["ply", "format binary_little_endian 1.0", f"element chunk {chunks}"]
    head += [*(f"property float {name}" for name in axes), f"element vertex {count}"]
    head += [f"property uint packed_{what}" for what in ("position", "rotation", "scale", "color")]
    return "\n".join([*head, "end_header", ""]).encode() + bytes(48 * chunks + 16 * count)


def spz_header(count: int, version: int = 3) -> bytes:
    """The header of an .spz without harmonics."""
    return b"NGSP" + struct.pack("<IIBBBB", version, count, 0, 12, 0, 0)


def spz_of_zstd(*, count: int, held: int) -> bytes:
    """An .spz of version 4 that announces `count` Gaussians and holds the bytes of `held`."""
    widths = (9, 1, 3, 3, 4)
    frames = [zstandard.compress(bytes(width * held)) for width in widths]
    sizes = [struct.pack("<QQ", len(f), w * count) for f, w in zip(frames, widths, strict=True)]
    head = spz_header(count, 4)[:15] + b"\5" + struct.pack("<I12x", 32)
    return head + b"".join([*sizes, *frames])


def ksplat_header(sections: int) -> bytes:
    """The first header of a .ksplat."""
    return struct.pack("<BBxxI", 0, 1, sections) + bytes(4088)


def _image(number: int, points: int = 0) -> bytes:
    pose = struct.pack("<I7dI", number, 1.0, 0.0, 0.0, 0.0, number, 0.0, 5.0, 1)
    return pose + b"%d.jpg\0" % number + struct.pack("<Q", points)
