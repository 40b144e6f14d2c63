"""Adds to an MP4 the metadata of a 360-degree video: Google's Spherical Video V1, as XML in a box of the track."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

UUID = bytes.fromhex("ffcc8263f8554a938814587a02521fdd")
XML = (
    '<?xml version="1.0"?><rdf:SphericalVideo xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#" '
    'xmlns:GSpherical="http://ns.google.com/videos/1.0/spherical/"><GSpherical:Spherical>true</GSpherical:Spherical>'
    "<GSpherical:Stitched>true</GSpherical:Stitched><GSpherical:StitchingSoftware>test</GSpherical:StitchingSoftware>"
    "<GSpherical:ProjectionType>equirectangular</GSpherical:ProjectionType></rdf:SphericalVideo>"
)


def call_spherical(path: Path) -> None:
    """Insert the box at the end of the first track of an MP4 whose `moov` follows its `mdat`."""
    data = path.read_bytes()
    box = struct.pack(">I4s", 24 + len(XML), b"uuid") + UUID + XML.encode()
    moov = _find(data, 0, len(data), b"moov")
    track = _find(data, moov + 8, len(data), b"trak")
    changed = bytearray(data)
    for start in (moov, track):
        size = struct.unpack_from(">I", data, start)[0]
        struct.pack_into(">I", changed, start, size + len(box))
    end = track + struct.unpack_from(">I", data, track)[0]
    path.write_bytes(bytes(changed[:end]) + box + bytes(changed[end:]))


def _find(data: bytes, start: int, end: int, kind: bytes) -> int:
    return next(at for at, name in _boxes(data, start, end) if name == kind)


def _boxes(data: bytes, start: int, end: int) -> Iterator[tuple[int, bytes]]:
    while start < end:
        size, name = struct.unpack_from(">I4s", data, start)
        yield start, name
        start += size
