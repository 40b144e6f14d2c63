"""Zips that lead elsewhere, unpack to too much, or contradict themselves."""

from __future__ import annotations

import io
import struct
import warnings
import zipfile
import zlib
from functools import cache

from tests.support.hostile.pictures import photo


def packed(files: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    """A zip of these files."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", method) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return data.getvalue()


def with_link() -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        entry = zipfile.ZipInfo("link.png")
        entry.external_attr = 0o120777 << 16
        archive.writestr(entry, "/etc/passwd")
    return data.getvalue()


def encrypted() -> bytes:
    """A zip whose entry says that it is encrypted."""
    data = bytearray(packed({"a.jpg": photo()}))
    data[6] |= 1  # of the local header
    data[data.rindex(b"PK\x01\x02") + 8] |= 1
    return bytes(data)


def twice() -> bytes:
    """A zip with two files of one name."""
    data = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(data, "w") as archive:
        warnings.simplefilter("ignore")
        for seed in range(2):
            archive.writestr("a.jpg", photo(seed))
    return data.getvalue()


def wrong_checksum() -> bytes:
    content = photo()
    return packed({"a.jpg": content}).replace(struct.pack("<I", zlib.crc32(content)), b"\1\2\3\4")


def damaged_bzip2() -> bytes:
    """A zip with bzip2 data of which a byte is wrong."""
    data = bytearray(packed({"a.jpg": photo()}, zipfile.ZIP_BZIP2))
    data[60] ^= 0xFF
    return bytes(data)


def overlapping(entries: int = 200) -> bytes:
    """A zip whose entries all name the same packed bytes: each is small, together they are a bomb."""
    data = packed({"0000.jpg": bytes(range(256)) * 400})
    start = data.index(b"PK\x01\x02")
    end = data.index(b"PK\x05\x06")
    entry = data[start:end]
    directory = b"".join(entry.replace(b"0000.jpg", b"%04d.jpg" % number) for number in range(entries))
    tail = struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, entries, entries, len(directory), start, 0)
    return data[:start] + directory + tail


@cache
def with_entries(count: int) -> bytes:
    """A zip of `count` empty files, made without zipfile, which would take long."""
    local = struct.pack("<4s5H3I2H", b"PK\3\4", 20, 0, 0, 0, 0, 0, 0, 0, 9, 0)
    central = struct.pack("<4s6H3I5H2I", b"PK\1\2", 20, 20, 0, 0, 0, 0, 0, 0, 0, 9, 0, 0, 0, 0, 0, 0)
    names = [b"%05d.jpg" % number for number in range(count)]
    body = b"".join(local + name for name in names)
    directory = b"".join(
        central[:42] + struct.pack("<I", number * (len(local) + 9)) + name
        for number, name in enumerate(names)
    )
    wide = struct.pack("<4sQ2H2I4Q", b"PK\6\6", 44, 45, 45, 0, 0, count, count, len(directory), len(body))
    locator = struct.pack("<4sIQI", b"PK\6\7", 0, len(body) + len(directory), 1)
    tail = struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, 0xFFFF, 0xFFFF, 0xFFFFFFFF, 0xFFFFFFFF, 0)
    return body + directory + wide + locator + tail


def gzip_of_zeros(head: bytes, zeros: int) -> bytes:
    """`head` and so many million zeros as gzip, without a time. A million is packed once and repeated, to be quick."""
    million = bytes(10**6)
    packer = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS)
    first = packer.compress(head) + packer.flush(zlib.Z_FULL_FLUSH)
    block = packer.compress(million) + packer.flush(zlib.Z_FULL_FLUSH)
    checksum = zlib.crc32(head)
    for _ in range(zeros):
        checksum = zlib.crc32(million, checksum)
    size = len(head) + zeros * 10**6
    start = b"\x1f\x8b\x08\x00\x00\x00\x00\x00\x02\xff"
    return start + first + zeros * block + packer.flush() + struct.pack("<II", checksum, size)


@cache
def many_small() -> bytes:
    """A zip of 193 files of a MiB of zeros, each too small for a ratio of its own."""
    return packed({f"{number:03d}.jpg": bytes(2**20) for number in range(193)}, zipfile.ZIP_DEFLATED)


@cache
def many_folders() -> bytes:
    """A zip whose 200 empty files lie in 110 folders each."""
    return packed({f"{number:03d}/" + "a/" * 109 + "b.jpg": b"" for number in range(200)})
