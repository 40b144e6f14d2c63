"""Zips whose names do not say how they are encoded, as programs of Windows write them."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path


class _Entry(zipfile.ZipInfo):
    """An entry with a name of these bytes, and no flag for UTF-8."""

    raw = b""

    def _encodeFilenameFlags(self) -> tuple[bytes, int]:
        return self.raw, 0


def write(place: Path, files: Sequence[tuple[bytes, bytes]], extra: Sequence[bytes] = ()) -> None:
    """Write a zip of files, each with the bytes of its name. extra: their extra fields."""
    with zipfile.ZipFile(place, "w") as packed:
        for number, (raw, data) in enumerate(files):
            entry = _Entry(str(number))
            entry.raw = raw
            entry.extra = extra[number] if extra else b""
            packed.writestr(entry, data)
