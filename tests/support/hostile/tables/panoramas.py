"""Hostile panoramas: their metadata, sizes and masks."""

from __future__ import annotations

import zlib

from tests.support.hostile.entry import Hostile
from tests.support.hostile.pictures import chunk, encoded, noise, png
from tests.support.panoramas import gpano

AREA = "Panoramas"
LEFT_OUT = "left out"


def _large() -> bytes:
    """A PNG of a panorama with 20,000 x 10,000 white pixels."""
    xmp = b"XML:com.adobe.xmp\0\0\0\0\0" + gpano(ProjectionType="equirectangular")
    packer = zlib.compressobj(9)
    rows = b"".join(packer.compress(b"\0" + b"\xff" * 2500) for _ in range(10_000)) + packer.flush()
    return png(20_000, 10_000, rows, bits=1, before=chunk(b"iTXt", xmp))


def _photo(width: int, height: int, xmp: bytes) -> bytes:
    return encoded(noise(width, height), "JPEG", quality=90, xmp=xmp)


def _row(what: str, data: bytes, kind: str, said: str) -> Hostile:
    return Hostile(AREA, what, lambda bench: bench.prepared("images/sphere.jpg", data), kind, said)


PANORAMAS = (
    _row("a panorama of 0 bytes", b"", LEFT_OUT, "the file is empty"),
    _row(
        "one cut off in its XMP",
        _photo(128, 64, gpano(ProjectionType="equirectangular"))[:120],
        LEFT_OUT,
        "",
    ),
    _row(
        "one whose XMP has sizes that are no numbers",
        _photo(
            128,
            64,
            gpano(
                ProjectionType="equirectangular", FullPanoWidthPixels="nan", CroppedAreaImageWidthPixels="0"
            ),
        ),
        "used",
        "1 photo",
    ),
    _row(
        "XMP of a panorama on a photo of another shape",
        _photo(96, 64, gpano(ProjectionType="equirectangular")),
        LEFT_OUT,
        "If it is a part of a panorama",
    ),
    _row(
        "a projection with a name of a thousand letters",
        _photo(128, 64, gpano(ProjectionType="x" * 1000)),
        LEFT_OUT,
        "which is not read",
    ),
    Hostile(
        AREA,
        "20,000 x 10,000 pixels in 25 kB",
        lambda bench: bench.prepared("images/sphere.jpg", _large()),
        "used",
        "1 photo",
    ),
    Hostile(
        AREA,
        "a mask of one with the shape of one of its faces",
        lambda bench: bench.prepared(
            "images/sphere.jpg",
            _photo(128, 64, gpano(ProjectionType="equirectangular")),
            {"masks/sphere.png": encoded(noise(64, 64).convert("L"), "PNG")},
        ),
        "used, with a note",
        "its shape differs from the photo's (64 x 64 and 128 x 64 pixels)",
    ),
)
