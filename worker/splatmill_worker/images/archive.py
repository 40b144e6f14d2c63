"""Unpacks zips from untrusted sources: names that leave the target folder, links and zip bombs are refused."""

from __future__ import annotations

import stat
import zipfile
from collections.abc import Callable
from pathlib import Path, PurePosixPath, PureWindowsPath

from splatmill_worker.errors import Cancelled

MAX_ENTRIES = 20_000
"""Files in an archive, at most."""

MAX_FILE_BYTES = 2 * 2**30
"""Bytes of an unpacked file, at most."""

MAX_TOTAL_BYTES = 16 * 2**30
"""Bytes of all unpacked files, at most."""

MAX_RATIO = 100
"""Largest ratio of a file's unpacked to packed size: photos and videos hardly compress, a zip bomb 1000 to 1."""

RATIO_FLOOR = 2**20
"""Bytes of an unpacked file up to which its ratio is not limited."""

CHUNK = 2**20
"""Bytes written at a time; size and cancellation are checked in between."""


class UnsafeArchive(ValueError):
    """The whole archive is refused; the message is the reason."""


def unpack(path: Path, target: Path, cancelled: Callable[[], bool] = lambda: False) -> list[Path]:
    """Write the archive's files under `target` and return their paths, in the archive's order.

    The declared sizes are checked before anything is written, and the real ones while writing. Hidden files and the
    resource forks of macOS are left out.

    Raises UnsafeArchive for absolute names, names with `..`, links, encrypted files, zip bombs, too many files, and
    files that are no complete zip; Cancelled when `cancelled()` turns true.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            entries = [entry for entry in archive.infolist() if not entry.is_dir()]
            _check_declared(entries)
            written: list[Path] = []
            total = 0
            for entry in entries:
                name = PurePosixPath(entry.filename)
                if any(part.startswith((".", "__MACOSX")) for part in name.parts):
                    continue
                place = target / name
                place.parent.mkdir(parents=True, exist_ok=True)
                total = _write(archive, entry, place, total, cancelled)
                written.append(place)
            return written
    except (zipfile.BadZipFile, NotImplementedError, EOFError) as error:
        raise UnsafeArchive(f"it is not a complete zip file ({error})") from error


def _check_declared(entries: list[zipfile.ZipInfo]) -> None:
    """Raise UnsafeArchive for names, kinds and sizes in the archive's directory that are not allowed."""
    if len(entries) > MAX_ENTRIES:
        raise UnsafeArchive(f"it holds {len(entries)} files; at most {MAX_ENTRIES} are allowed")
    seen: set[str] = set()
    for entry in entries:
        name = entry.filename
        windows = PureWindowsPath(name)
        if PurePosixPath(name).is_absolute() or windows.drive or windows.root or ".." in windows.parts:
            raise UnsafeArchive(f"the name {name!r} points outside the archive")
        if "\x00" in name or not name.strip("/. "):
            raise UnsafeArchive(f"the name {name!r} is not a file name")
        if stat.S_IFMT(entry.external_attr >> 16) not in (0, stat.S_IFREG):
            raise UnsafeArchive(f"{name!r} is a link or a device, not a file")
        if entry.flag_bits & 1:
            raise UnsafeArchive(f"{name!r} is encrypted")
        if name in seen:
            raise UnsafeArchive(f"two files are called {name!r}")
        seen.add(name)
        if entry.file_size > MAX_FILE_BYTES:
            raise UnsafeArchive(
                f"{name!r} has {entry.file_size} bytes when unpacked; at most {MAX_FILE_BYTES} are allowed"
            )
        if entry.file_size > RATIO_FLOOR and entry.file_size > MAX_RATIO * max(entry.compress_size, 1):
            ratio = entry.file_size // max(entry.compress_size, 1)
            raise UnsafeArchive(
                f"{name!r} is compressed {ratio} to 1, where at most {MAX_RATIO} to 1 is allowed; it may be a zip bomb"
            )
    total = sum(entry.file_size for entry in entries)
    if total > MAX_TOTAL_BYTES:
        raise UnsafeArchive(
            f"its files have {total} bytes when unpacked; at most {MAX_TOTAL_BYTES} are allowed"
        )


def _write(
    archive: zipfile.ZipFile, entry: zipfile.ZipInfo, place: Path, total: int, cancelled: Callable[[], bool]
) -> int:
    """Write one entry to `place`; returns `total` plus the number of bytes that were really written."""
    size = 0
    with archive.open(entry) as source, place.open("wb") as sink:
        while chunk := source.read(CHUNK):
            if cancelled():
                raise Cancelled(f"Unpacking {entry.filename} was cancelled.")
            size += len(chunk)
            total += len(chunk)
            if size > entry.file_size or size > MAX_FILE_BYTES or total > MAX_TOTAL_BYTES:
                raise UnsafeArchive(
                    f"{entry.filename!r} is larger than its header says; it may be a zip bomb"
                )
            sink.write(chunk)
    return total
