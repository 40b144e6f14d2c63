"""Unpacks zips from untrusted sources: names that leave the target folder, links and zip bombs are refused."""

from __future__ import annotations

import errno
import io
import lzma
import stat
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import IO, cast

from splatmill_worker.errors import Cancelled, Refusal
from splatmill_worker.images.archives import unpacked_room, zip_names
from splatmill_worker.images.signatures import recognised
from splatmill_worker.settings import max_unpacked
from splatmill_worker.wording import plain

MAX_ENTRIES = 20_000
"""Files in all archives of a capture, at most."""

MAX_FILE_BYTES = 2 * 2**30
"""Bytes of an unpacked file, at most."""

MAX_FOLDERS = MAX_ENTRIES
"""Folders that the names of an archive's files make, at most: each takes a block of the disk."""

MAX_DIRECTORY_BYTES = 256 * MAX_ENTRIES
"""Bytes of an archive's list of files. It is read at once, and takes ten times the memory."""

MAX_RATIO = 100
"""Largest ratio of unpacked to packed size, of a file and of the whole archive: photos and videos hardly compress, a
zip bomb 1000 to 1."""

RATIO_FLOOR = 2**20
"""Bytes of an unpacked file, and of all files of an archive, up to which their ratio is not limited."""

REMARK = ".names"
"""A file beside those of an archive, with a sentence for the user about how their names were read."""

_LOCAL_HEADER_BYTES = 30
"""Bytes before a packed file, without its name."""

DAMAGED = (zipfile.BadZipFile, NotImplementedError, EOFError, zlib.error, lzma.LZMAError, struct.error)
"""What zipfile raises for damaged archives and for packing methods that it does not know."""

_DAMAGED_ERRNOS = (None, errno.EINVAL)
"""Of the OSErrors that bz2 raises for damaged data, and that places outside of the file lead to."""

_NAME_ERRNOS = (errno.EEXIST, errno.EISDIR, errno.ENOTDIR, errno.ENAMETOOLONG, errno.EILSEQ)
"""Of the OSErrors that creating a file under a name raises for the name: it is too long, has characters that the file
system does not know, or is that of a file and of a folder."""

CHUNK = 2**20
"""Bytes written at a time; size and cancellation are checked in between."""


class UnsafeArchive(ValueError):
    """The whole archive is refused; the message is the reason."""


@dataclass
class Allowance:
    """What the archives and videos of a capture may still unpack to, together.

    files: number of files, those of archives.
    bytes: of all files; at first those of the setting `max_unpacked`.
    """

    files: int = MAX_ENTRIES
    bytes: int = field(default_factory=max_unpacked)

    def take(self, archive: str, files: int, size: int) -> None:
        """Subtract `files` with `size` bytes. Raises Refusal, naming the archive, when that is more than is left."""
        if files > self.files or size > self.bytes:
            raise Refusal(
                "archive_bomb",
                f"With {archive}, the archives and videos of the capture unpack to more than {MAX_ENTRIES} files or "
                f"{max_unpacked()} bytes: it has {files} files and {size} bytes, where {self.files} and {self.bytes} "
                "are left.",
                facts={"file": archive, "files": files, "bytes": size},
                advice="Give fewer or smaller photos.",
            )
        self.files -= files
        self.bytes -= size


def unpack(
    path: Path,
    target: Path,
    cancelled: Callable[[], bool] = lambda: False,
    allowance: Allowance | None = None,
) -> list[Path]:
    """Write the archive's files under `target` and return their paths, in the archive's order.

    The declared sizes are checked before anything is written, and the real ones while writing: none exceeds what was
    declared. Hidden files and the resource forks of macOS are left out. Where the encoding of the names is a guess, the
    file REMARK says so. What is written is taken from `allowance` and
    from the owner's room, before it is written.

    Raises UnsafeArchive for absolute names, names with `..`, names that no file can have, links, encrypted files, files
    that overlap, zip bombs, too many files or folders, and files that are no complete zip; Refusal when
    the allowance is exceeded; Cancelled when `cancelled()` turns true.
    """
    try:
        bounded = BoundedReads(io.FileIO(path), MAX_DIRECTORY_BYTES, _list_too_long)
        with bounded as file, zipfile.ZipFile(cast(IO[bytes], file)) as archive:
            _check_places(archive)
            remark = zip_names.decode(archive)
            for entry in archive.infolist():
                entry.filename = entry.filename.replace("\\", "/")  # as some programs of Windows write them
            entries = [entry for entry in archive.infolist() if not entry.filename.endswith("/")]
            _check_declared(entries)
            _check_folders(entries)
            declared = sum(entry.file_size for entry in entries)
            _check_ratio(declared, path.stat().st_size)
            (allowance or Allowance()).take(path.name, len(entries), declared)
            unpacked_room.take(target.name.removesuffix(".partial"), declared)
            written: list[Path] = []
            for entry in entries:
                name = PurePosixPath(entry.filename)
                if any(part.startswith((".", "__MACOSX")) for part in name.parts):
                    continue
                place = target / name
                try:
                    place.parent.mkdir(parents=True, exist_ok=True)
                    _write(archive, entry, place, cancelled)
                except OSError as error:
                    if error.errno not in _NAME_ERRNOS:
                        raise
                    raise UnsafeArchive(
                        f"no file can have the name {entry.filename[:200]!r} ({error.strerror})"
                    ) from error
                written.append(place)
            if remark:
                (target / REMARK).write_text(remark, "utf-8")
            return written
    except UnsafeArchive:
        raise
    except (*DAMAGED, RuntimeError, ValueError) as error:
        raise UnsafeArchive(f"it is not a complete zip file ({_fault(path, error)})") from error
    except OSError as error:
        if error.errno not in _DAMAGED_ERRNOS:
            raise
        raise UnsafeArchive(f"it is not a complete zip file ({_fault(path, error)})") from error


def _fault(path: Path, error: Exception) -> str:
    """Why an archive cannot be read, as a part of a sentence."""
    if (kind := recognised(path)) not in (None, "a zip archive"):
        return f"it is {kind}"
    if not zipfile.is_zipfile(path):
        return "the list of its files, at its end, is missing: it is cut off, or no zip at all"
    return plain(error)


class BoundedReads(io.BufferedReader):
    """A file of which no single read takes more than `most` bytes into memory, while that is not None.

    `zipfile` reads an archive's list of files at once, however its length is written.

    refused: makes the error of a longer read, whose length it is called with.
    """

    def __init__(self, raw: io.FileIO, most: int, refused: Callable[[int], Exception]) -> None:
        super().__init__(raw)
        self.most: int | None = most
        self._refused = refused

    def read(self, size: int | None = -1, /) -> bytes:
        if size is None or size < 0:
            here = self.tell()
            size = self.seek(0, io.SEEK_END) - here
            self.seek(here)
        if self.most is not None and size > self.most:
            raise self._refused(size)
        return super().read(size)


def _list_too_long(size: int) -> UnsafeArchive:
    return UnsafeArchive(
        f"its list of files has {size} bytes; at most {MAX_DIRECTORY_BYTES} are allowed, for {MAX_ENTRIES} files"
    )


def _check_places(archive: zipfile.ZipFile) -> None:
    """Raise UnsafeArchive when two entries share bytes of the file: the trick of zip bombs that nest nothing."""
    if not archive.infolist():
        raise UnsafeArchive("it is an empty zip file: there is no file in it")
    placed = sorted(archive.infolist(), key=lambda entry: entry.header_offset)
    ends = [entry.header_offset for entry in placed[1:]] + [archive.start_dir]
    for entry, end in zip(placed, ends, strict=True):
        if entry.header_offset + _LOCAL_HEADER_BYTES + entry.compress_size > end:
            raise UnsafeArchive(f"{entry.filename!r} overlaps with another file; it may be a zip bomb")


def _check_declared(entries: list[zipfile.ZipInfo]) -> None:
    """Raise UnsafeArchive for names, kinds and sizes in the archive's directory that are not allowed."""
    if len(entries) > MAX_ENTRIES:
        raise UnsafeArchive(f"it holds {len(entries)} files; at most {MAX_ENTRIES} are allowed")
    names: set[str] = set()
    for entry in entries:
        name = entry.filename
        windows = PureWindowsPath(name)
        # A colon after one letter is no drive of Windows unless the path is absolute: `x:1.jpg` is a photo.
        if PurePosixPath(name).is_absolute() or windows.root or ".." in windows.parts:
            raise UnsafeArchive(f"the name {name!r} points outside the archive")
        if "\x00" in name or not name.strip("/. "):
            raise UnsafeArchive(f"the name {name!r} is not a file name")
        if stat.S_IFMT(entry.external_attr >> 16) not in (0, stat.S_IFREG):
            raise UnsafeArchive(f"{name!r} is a link or a device, not a file")
        if entry.flag_bits & 1:
            raise UnsafeArchive(f"{name!r} is encrypted")
        if name in names:
            raise UnsafeArchive(f"two files are called {name!r}")
        names.add(name)
        if entry.file_size > MAX_FILE_BYTES:
            raise UnsafeArchive(
                f"{name!r} has {entry.file_size} bytes when unpacked; at most {MAX_FILE_BYTES} are allowed"
            )
        if entry.file_size > RATIO_FLOOR and entry.file_size > MAX_RATIO * max(entry.compress_size, 1):
            ratio = entry.file_size // max(entry.compress_size, 1)
            raise UnsafeArchive(
                f"{name!r} is compressed {ratio} to 1, where at most {MAX_RATIO} to 1 is allowed; it may be a zip bomb"
            )


def _check_folders(entries: list[zipfile.ZipInfo]) -> None:
    """Raise UnsafeArchive when the names lead through too many folders."""
    folders: set[PurePosixPath] = set()
    for entry in entries:
        for folder in PurePosixPath(entry.filename).parents:
            if folder in folders:
                break  # and so are those above it
            folders.add(folder)
            if len(folders) > MAX_FOLDERS:
                raise UnsafeArchive(f"its files lie in more than {MAX_FOLDERS} folders")


def _check_ratio(unpacked: int, packed: int) -> None:
    """Raise UnsafeArchive when an archive of `packed` bytes as a whole unpacks to too many."""
    if unpacked > RATIO_FLOOR and unpacked > MAX_RATIO * packed:
        raise UnsafeArchive(
            f"it is compressed {unpacked // max(packed, 1)} to 1 as a whole, where at most {MAX_RATIO} to 1 is "
            "allowed; it may be a zip bomb"
        )


def _write(
    archive: zipfile.ZipFile, entry: zipfile.ZipInfo, place: Path, cancelled: Callable[[], bool]
) -> None:
    """Write one entry to `place`. Raises UnsafeArchive when it has more bytes than its header says."""
    size = 0
    with archive.open(entry) as source, place.open("wb") as sink:
        while chunk := source.read(CHUNK):
            if cancelled():
                raise Cancelled(f"Unpacking {entry.filename} was cancelled.")
            size += len(chunk)
            if size > entry.file_size:
                raise UnsafeArchive(
                    f"{entry.filename!r} is larger than its header says; it may be a zip bomb"
                )
            sink.write(chunk)
