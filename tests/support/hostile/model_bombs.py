"""Small files that announce models, cameras or points of gigabytes, and some that would become them."""

from __future__ import annotations

import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from PIL import Image

from splatmill_worker.splat.formats import glb
from tests.support.hostile import archives, models
from tests.support.hostile.pictures import encoded, png

PLANES = ("means_l", "means_u", "scales", "quats", "sh0")


def sog(
    planes: dict[str, bytes], count: int, *, files: dict[str, str] | None = None, degree: int = 0
) -> bytes:
    """A SOG archive of these members, deflated, whose planes are those named in `files`, each itself by default."""
    named = {plane: (files or {}).get(plane, f"{plane}.webp") for plane in (*PLANES, "centroids", "labels")}
    book = [0.0] * 256
    meta: dict[str, Any] = {
        "version": 2,
        "count": count,
        "means": {"mins": [0] * 3, "maxs": [1] * 3, "files": [named["means_l"], named["means_u"]]},
        "scales": {"codebook": book, "files": [named["scales"]]},
        "quats": {"files": [named["quats"]]},
        "sh0": {"codebook": book, "files": [named["sh0"]]},
    }
    if degree:
        meta["shN"] = {"bands": degree, "codebook": book, "files": [named["centroids"], named["labels"]]}
    return archives.packed({"meta.json": json.dumps(meta).encode(), **planes}, zipfile.ZIP_DEFLATED)


@cache
def webp(side: int) -> bytes:
    """A lossless picture of one colour, square: about a hundred bytes, whatever its size."""
    return encoded(Image.new("RGBA", (side, side), (9, 9, 9, 255)), "WEBP", lossless=True, method=0)


@cache
def png_plane(side: int) -> bytes:
    """A picture of one bit a pixel, which a zip packs a second time: 250 megapixels in a hundred bytes."""
    row = b"\0" * (1 + (side + 7) // 8)
    packer = zlib.compressobj(9)
    return png(side, side, b"".join(packer.compress(row) for _ in range(side)) + packer.flush(), bits=1)


def sog_of_one_png() -> bytes:
    """One PNG of 250 megapixels serves every plane of 1,000 Gaussians."""
    return sog({"a.png": png_plane(15_800)}, 1000, files=dict.fromkeys(PLANES, "a.png"))


def sog_of_pngs() -> bytes:
    """Each plane is a PNG of 250 megapixels of its own."""
    return sog({f"{plane}.webp": png_plane(15_800) for plane in PLANES}, 1000)


def sog_of_webps(side: int, count: int) -> bytes:
    """Each plane is a picture of one colour."""
    return sog({f"{plane}.webp": webp(side) for plane in PLANES}, count)


def sog_of_palette() -> bytes:
    """A few Gaussians whose palette is a picture of 960 x 16,000 pixels."""
    palette = encoded(Image.new("RGB", (64 * 15, 16_000)), "WEBP", lossless=True, method=0)
    planes = {f"{plane}.webp": webp(8) for plane in (*PLANES, "labels")}
    return sog(planes | {"centroids.webp": palette}, 50, degree=3)


def sog_of_zeros() -> bytes:
    """A plane is a gigabyte of zeros, deflated to a megabyte and then to a kilobyte, as some readers inflate it."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("meta.json", zipfile.ZipFile(io.BytesIO(sog({}, 1000))).read("meta.json"))
        with archive.open("means_l.webp", "w") as member:
            for _ in range(256):
                member.write(bytes(2**20))
        for plane in PLANES[1:]:
            archive.writestr(f"{plane}.webp", webp(32))
    return data.getvalue()


def sog_of_members() -> bytes:
    """An archive with a list of 100,000 members."""
    return archives.packed({f"{number}": b"" for number in range(60_000)})


def sog_of_json() -> bytes:
    """A meta.json of 16 MB of empty objects, deflated."""
    return archives.packed({"meta.json": b"[" + b"{}," * (5 * 2**20) + b"0]"}, zipfile.ZIP_DEFLATED)


def glb_of_one_view(count: int) -> bytes:
    """A .glb of degree 3 whose attributes all lie in the same three bytes a Gaussian."""
    names = [f"{glb.EXTENSION}:SH_DEGREE_{d}_COEF_{o}" for d in range(4) for o in range(2 * d + 1)]
    # 0: three bytes a Gaussian; 1: one byte; 2: four.
    kinds = {"POSITION": 0, f"{glb.EXTENSION}:SCALE": 0, f"{glb.EXTENSION}:OPACITY": 1}
    kinds |= {f"{glb.EXTENSION}:ROTATION": 2, **dict.fromkeys(names, 0)}
    accessors = [
        {"bufferView": 0, "componentType": 5121, "count": count, "type": kind, "normalized": True}
        for kind in ("VEC3", "SCALAR", "VEC4")
    ]
    extension = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {"mode": 0, "attributes": kinds, "extensions": {glb.EXTENSION: extension}}
    document = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": 4 * count}],
        "bufferViews": [
            {"buffer": 0, "byteLength": 4 * count, "byteStride": 3},
            {"buffer": 0, "byteLength": 4 * count},
        ],
        "accessors": [accessors[0], accessors[1], accessors[2] | {"bufferView": 1}],
        "meshes": [{"primitives": [primitive]}],
        "nodes": [{"mesh": 0}],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    data = b"\x7f" * (4 * count)
    total = 12 + 8 + len(text) + 8 + len(data)
    head = struct.pack("<4sII", b"glTF", 2, total) + struct.pack("<I4s", len(text), b"JSON")
    return head + text + struct.pack("<I4s", len(data), b"BIN\0") + data


def glb_of_json() -> bytes:
    """A .glb with a document of 12 MB of empty objects."""
    text = b"[" + b"{}," * (4 * 2**20 - 1) + b"{}]"
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text), len(text), b"JSON") + text


def spz_of_degree(count: int) -> bytes:
    """An .spz of degree 3 whose streams are zeros, in gzip."""
    head = bytearray(models.spz_header(count))
    head[12] = 3
    return archives.gzip_of_zeros(bytes(head), 65 * count // 10**6 + 1)


MODELS: dict[str, tuple[str, Callable[[], bytes]]] = {
    "a .sog of which one PNG of 250 megapixels serves every plane": (".sog", sog_of_one_png),
    "a .sog whose planes are PNGs of 250 megapixels": (".sog", sog_of_pngs),
    "a .sog of 1,000 Gaussians whose planes have 16 million pixels": (
        ".sog",
        lambda: sog_of_webps(4000, 1000),
    ),
    "a .sog of 1 kB that announces 4 million Gaussians, and has their pixels": (
        ".sog",
        lambda: sog_of_webps(2000, 4_000_000),
    ),
    "a .sog whose palette has 16,000 rows": (".sog", sog_of_palette),
    "a .sog of 268 kB with a plane that inflates to 256 MB": (".sog", sog_of_zeros),
    "a .sog with 60,000 members": (".sog", sog_of_members),
    "a .sog whose meta.json has 5 million objects": (".sog", sog_of_json),
    "a .glb whose attributes all lie in the same bytes": (".glb", lambda: glb_of_one_view(600_000)),
    "a .glb with a document of 4 million objects": (".glb", glb_of_json),
    "an .spz of 500 kB with 8 million Gaussians of degree 3": (".spz", lambda: spz_of_degree(8_000_000)),
}
"""Files that are refused: suffix, and a function that makes them, by what they are."""


def dense_text(points: int) -> str:
    """A points3D.txt of points without tracks, as short as they can be."""
    return "1 0 0 0 0 0 0 0\n" * points


def short_images(count: int) -> bytes:
    """An images.bin of `count` images without a name or features."""
    row = np.zeros(
        count, [("id", "<u4"), ("pose", "<f8", 7), ("camera", "<u4"), ("name", "u1"), ("points", "<u8")]
    )
    row["id"], row["camera"] = np.arange(1, count + 1), 1
    row["pose"][:, 0] = 1.0
    return struct.pack("<Q", count) + row.tobytes()


def ply_of_bytes(count: int) -> bytes:
    """A .ply of points whose coordinates are bytes: they become float64."""
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    head += [f"property uchar {name}" for name in "xyz"]
    return "\n".join([*head, "end_header", ""]).encode() + bytes(3 * count)


def nested_json(objects: int) -> bytes:
    """A transforms.json with empty objects of three bytes each, in a field that is not read."""
    return models.transforms()[:-1] + b', "x": [' + b"{}," * objects + b"0]}"
