"""The names of the files in a zip whose program did not say how they are encoded.

Such a program writes them as UTF-8 or in the encoding of its system. They are read in the encoding that makes them
those that the cameras in the zip name, or else in the first one in which they are words of its script.
"""

from __future__ import annotations

import re
import struct
import unicodedata
import zipfile
import zlib
from collections.abc import Sequence
from fnmatch import fnmatchcase
from os.path import splitext

from splatmill.data_sets import TRANSFORMS

_HAN = "\u3005\u4e00-\u9fff"

ENCODINGS = {
    "cp866": ("Russian", "(?:[\u0410-\u042f\u0401]?[\u0430-\u044f\u0451]+|[\u0410-\u042f\u0401]{2,})"),
    "cp932": ("Japanese", f"[{_HAN}\u3041-\u30fe\uff10-\uff19\uff21-\uff3a\uff41-\uff5a]+"),
    "cp949": ("Korean", "[\uac00-\ud7a3]+"),
    "gb18030": ("Chinese, simplified", f"[{_HAN}]+"),
    "cp950": ("Chinese, traditional", f"[{_HAN}]+"),
    "cp850": ("Western European", "[\u00c0-\u00ff]+"),
    "cp852": ("Central European", "[\u00c0-\u017f]+"),
    "cp1251": (
        "Russian, of Windows",
        "(?:[\u0410-\u042f\u0401]?[\u0430-\u044f\u0451]+|[\u0410-\u042f\u0401]{2,})",
    ),
    "cp1252": ("Western European, of Windows", "[\u00c0-\u00ff\u0152-\u0178]+"),
    "cp437": ("the original one of zips", ".+"),
}
"""Encodings of names in the order in which they are tried, with what they are for, and a pattern of what words without
ASCII have in them. The page tries the same order (server/splatmill_server/web/page/new/zip.js)."""

UTF8 = 0x800
"""Flag of an entry whose name is UTF-8."""

_UNICODE_NAME = 0x7075
"""Extra field of Info-ZIP with the name in UTF-8 and the CRC of the other one."""

CAMERA_BYTES = 16 * 2**20
"""Bytes of a file of cameras in which names are looked for."""

CAMERA_FILES = 4
"""Files of cameras in which names are looked for."""

_WORD = re.compile(r"[^\s/\\\"\0]*[^\x00-\x7f\ufffd][^\s/\\\"\0]*")
_MIXED = re.compile(r"[A-Za-z]*[^\x00-\x7f][^\x00-\x7f]*[A-Za-z]*")


def decode(archive: zipfile.ZipFile) -> str:
    """Give the entries the names that were meant; return a sentence for the user where their encoding is a guess.

    The sentence is "" where all names say how they are encoded, are ASCII, or are UTF-8.
    """
    unmarked = {
        entry: raw
        for entry in archive.infolist()
        if not entry.flag_bits & UTF8 and not (raw := entry.orig_filename.encode("cp437")).isascii()
    }
    for entry, raw in list(unmarked.items()):
        if (name := _extra_name(entry.extra, raw)) is not None:
            entry.filename = name
            del unmarked[entry]
    names = list(unmarked.values())
    possible = [each for each in ("utf-8", *ENCODINGS) if _decodes(names, each)]
    if not names or possible[0] == "utf-8":
        for entry, raw in unmarked.items():
            entry.filename = raw.decode()
        return ""
    known = _known(archive)
    hits = {each: sum(_words(raw.decode(each)) <= known for raw in names) for each in possible if known}
    best = max(possible, key=lambda each: hits.get(each, 0))
    by_cameras = hits.get(best, 0) > 0
    alone = [each for each in possible if _fits(names, each, mixed=False)]
    fitting = alone or [each for each in possible if _fits(names, each, mixed=True)]
    chosen = best if by_cameras else (fitting or possible)[0]
    for entry, raw in unmarked.items():
        entry.filename = raw.decode(chosen)
    first = names[0]
    said = f"The zip does not say how its names are encoded. They are read as {label(chosen)}: {first.decode(chosen)}"
    if by_cameras:
        return f"{said}, as the cameras name them."
    others = [each for each in [*fitting, *possible] if first.decode(each) != first.decode(chosen)]
    other = f"; as {label(others[0])}, this is {first.decode(others[0])}" if others else ""
    return f"{said}{other}. If that is wrong, pack the files with a program that writes UTF-8."


def label(encoding: str) -> str:
    """An encoding and what it is for, as a part of a sentence."""
    return f"{encoding} ({ENCODINGS[encoding][0]})"


def _decodes(names: Sequence[bytes], encoding: str) -> bool:
    try:
        return all(name.decode(encoding) for name in names)
    except UnicodeDecodeError:
        return False


def _fits(names: Sequence[bytes], encoding: str, mixed: bool) -> bool:
    """Whether all words with characters beyond ASCII are of the script of an encoding: whole words if not `mixed`, or
    accents on less than half of their letters."""
    script = re.compile(ENCODINGS[encoding][1])
    for name in names:
        for word in _MIXED.findall(name.decode(encoding)):
            beyond = "".join(char for char in word if not char.isascii())
            if not script.fullmatch(beyond):
                return False
            latin = all(unicodedata.name(char, "").startswith("LATIN") for char in beyond)
            if 2 * len(beyond) > len(word) if latin else word != beyond and not mixed:
                return False
    return True


def _extra_name(extra: bytes, raw: bytes) -> str | None:
    """The name in the extra field of Info-ZIP, where that is of this very name."""
    while len(extra) >= 4:
        kind, size = struct.unpack_from("<HH", extra)
        field, extra = extra[4 : 4 + size], extra[4 + size :]
        if kind == _UNICODE_NAME and len(field) > 5 and field[0] == 1:
            (checksum,) = struct.unpack_from("<I", field, 1)
            if checksum == zlib.crc32(raw):
                try:
                    return field[5:].decode().replace("\0", "")
                except UnicodeDecodeError:
                    return None
    return None


def _words(name: str) -> set[str]:
    """The words that are not ASCII in the last part of a path that has such, without its suffix."""
    parts = [part for part in name.replace("\\", "/").split("/") if not part.isascii()]
    return set(_WORD.findall(unicodedata.normalize("NFC", splitext(parts[-1])[0]))) if parts else set()


def _known(archive: zipfile.ZipFile) -> set[str]:
    """The words that are not ASCII in the files of cameras, as far as these are read, with and without suffixes."""
    words: set[str] = set()
    read = 0
    for entry in archive.infolist():
        base = entry.orig_filename.replace("\\", "/").rpartition("/")[2].lower()
        is_cameras = base in ("images.txt", "images.bin") or fnmatchcase(base, TRANSFORMS)
        if not is_cameras or entry.flag_bits & 1 or read == CAMERA_FILES:
            continue
        read += 1
        with archive.open(entry) as file:
            text = file.read(CAMERA_BYTES).decode("utf-8", "replace")
        if base.endswith(".json"):
            text = re.sub(r"\\u([0-9a-fA-F]{4})", lambda match: chr(int(match[1], 16)), text)
        matches = _WORD.findall(unicodedata.normalize("NFC", text))
        words.update(matches, (splitext(word)[0] for word in matches))
    return words
