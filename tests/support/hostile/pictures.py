"""Pictures that are damaged, lie about themselves, or are larger than they look."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import numpy as np
from PIL import Image

EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 100 100\n(/etc/passwd) run\n%%EOF\n"
SVG = b'<svg xmlns="http://www.w3.org/2000/svg"><image href="file:///etc/passwd" width="9" height="9"/></svg>'


def noise(width: int = 64, height: int = 48, seed: int = 0) -> Image.Image:
    return Image.fromarray(np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8))


def encoded(picture: Image.Image, form: str, **options: object) -> bytes:
    data = io.BytesIO()
    picture.save(data, form, **options)
    return data.getvalue()


def photo(seed: int = 0) -> bytes:
    """A small JPEG, different for each seed."""
    return encoded(noise(seed=seed), "JPEG", quality=90)


def png(width: int, height: int, rows: bytes, *, bits: int = 8, color: int = 0, before: bytes = b"") -> bytes:
    """A PNG whose compressed rows are `rows`; `before` are further chunks ahead of these."""
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + before + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def bomb(width: int = 27_000, height: int = 25_000) -> bytes:
    """A whole PNG of white pixels, one bit each: 675 megapixels in 117 kB, which decode to 675 MB."""
    packer = zlib.compressobj(9)
    row = b"\0" + b"\xff" * ((width + 7) // 8)
    rows = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()
    return png(width, height, rows, bits=1)


def text_bomb() -> bytes:
    """A PNG with a text that unpacks to 64 MB."""
    text = b"Comment\0\0" + zlib.compress(bytes(64 * 2**20), 1)
    rows = zlib.compress(b"\0" * 65 * 48)
    return png(64, 48, rows, before=chunk(b"zTXt", text))


def with_exif(exif: bytes, seed: int = 0) -> bytes:
    """A JPEG with these bytes as its EXIF data."""
    return encoded(noise(seed=seed), "JPEG", exif=b"Exif\0\0" + exif)


def turned_with_rubbish() -> bytes:
    """EXIF data that turns the photo by 90 degrees and has tags of wrong types and places."""
    tags = [
        struct.pack("<HHII", 0x0112, 3, 1, 6),  # orientation
        struct.pack("<HHII", 0x010F, 2, 0xFFFFFFF0, 0xFFFFFFF0),  # make: 4 GB, outside of the file
        struct.pack("<HHII", 0x8769, 4, 1, 8),  # the details lie where this list does: a loop
        struct.pack("<HHII", 0x8825, 4, 1, 0xFFFFFFFF),  # GPS outside of the file
        struct.pack("<HHII", 0x9999, 77, 9, 9),  # a type that does not exist
    ]
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + b"".join(tags) + struct.pack("<I", 8)


def huge_tiff() -> bytes:
    """A TIFF header of 65,000 x 65,000 pixels in one strip."""
    tags = [
        (256, 4, 65_000),
        (257, 4, 65_000),
        (258, 3, 8),
        (259, 3, 1),
        (262, 3, 1),
        (273, 4, 8),
        (278, 4, 65_000),
    ]
    tags += [(279, 4, 65_000 * 65_000 % 2**32)]
    entries = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in tags)
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + struct.pack("<I", 0)


def write(path: Path, data: bytes) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path
