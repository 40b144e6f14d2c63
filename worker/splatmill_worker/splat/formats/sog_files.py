"""The files of a model in the SOG format: members of a zip archive, or files beside its `meta.json`."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import IO, Protocol, cast

from splatmill_worker.images.archives.archive import BoundedReads

MAX_LIST_BYTES = 2**17
"""Bytes of an archive's list of its members, of which a model has up to eight; `zipfile` reads half as many to find the
list, those that a comment may take."""

_ENCRYPTED = 1
"""The bit of a member's flags that says so."""


class Files(Protocol):
    """The files of a model: `size` is the bytes of one before it is read, `read` its contents."""

    def size(self, name: str) -> int: ...

    def read(self, name: str) -> bytes: ...


class Members:
    """The members of an archive. Raises ValueError for one that is encrypted or missing.

    folder: what their names begin with in the archive: empty, or with a slash at its end.
    """

    def __init__(self, archive: zipfile.ZipFile, folder: str = "") -> None:
        self._archive = archive
        self._folder = folder

    def size(self, name: str) -> int:
        return self._info(name).file_size

    def read(self, name: str) -> bytes:
        if self._info(name).flag_bits & _ENCRYPTED:
            raise ValueError(f"{name[:80]} is encrypted")
        return self._archive.read(self._folder + name)

    def _info(self, name: str) -> zipfile.ZipInfo:
        if (path := self._folder + name) not in self._archive.NameToInfo:
            raise ValueError(f"{path[-80:]} is missing in it")
        return self._archive.NameToInfo[path]


class Beside:
    """The files beside a `meta.json`, which is `path`. Raises ValueError for one in another folder."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def size(self, name: str) -> int:
        return self._file(name).stat().st_size

    def read(self, name: str) -> bytes:
        return self._file(name).read_bytes()

    def _file(self, name: str) -> Path:
        if PurePosixPath(name).name != name:
            raise ValueError(f"meta.json names a file outside of its folder: {name[:80]!r}")
        if name == "meta.json":
            return self._path
        if not (beside := self._path.with_name(name)).is_file():
            raise ValueError(f"{name[:80]} is missing beside it")
        return beside


@contextmanager
def opened(path: Path) -> Iterator[Files]:
    """The files of an archive, or those beside a `meta.json`. Raises ValueError, and what `zipfile` does."""
    if not zipfile.is_zipfile(path):
        if path.is_file() and path.suffix.lower() != ".json":
            raise ValueError("it is no zip archive, or it is cut off")
        yield Beside(path)
        return
    bounded = BoundedReads(io.FileIO(path), MAX_LIST_BYTES, _list_too_long)
    with bounded as file, zipfile.ZipFile(cast(IO[bytes], file)) as archive:
        file.most = None  # each member is compared with what is expected of it
        yield Members(archive)


def _list_too_long(size: int) -> ValueError:
    return ValueError(f"its list of files has {size} bytes, and {MAX_LIST_BYTES} at most are read")


def contents(files: Files, name: str, most: int) -> bytes:
    """The contents of a file of at most `most` bytes. Raises ValueError for a larger one."""
    if files.size(name) > most:
        raise ValueError(f"{name[:80]} has {files.size(name)} bytes, more than {most}")
    return files.read(name)
