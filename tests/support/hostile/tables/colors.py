"""Hostile colours and times of pictures and videos."""

from __future__ import annotations

import struct
import zlib

from tests.support.hostile import videos
from tests.support.hostile.bench import Answer, Bench
from tests.support.hostile.entry import Hostile
from tests.support.hostile.pictures import encoded, noise


def _with_chunk(kind: bytes, content: bytes) -> bytes:
    """A PNG with a chunk behind its header."""
    data = encoded(noise(), "PNG")
    chunk = struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
    return data[:33] + chunk + data[33:]


def _colors_unknown(bench: Bench) -> Answer:
    return bench.prepared("images/a.png", _with_chunk(b"cICP", bytes([255, 254, 253, 1])))


def _jump(bench: Bench) -> Answer:
    data = videos.video("matroska", stamps=lambda number: number + 360_000 * (number > 5))
    return bench.prepared("images/a.mkv", data)


COLORS = (
    Hostile("Pictures", "colour tags that nobody has defined", _colors_unknown, "used", "1 photo"),
    Hostile("Videos", "time stamps that jump by ten hours", _jump, "used", "4 photos"),
)
