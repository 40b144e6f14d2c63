"""Streamed SOG in one file: a `lod-meta.json` and all that it names, in a .zip that viewers read piece by piece.

The files of a chunk lie together and are stored as they are, and the index comes last, before the archive's list of its
files. So one range of bytes, from the end, says where everything is, and one more brings each chunk.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import IO, cast

from splatmill.files import replacing
from splatmill_worker.images.archives.archive import BoundedReads
from splatmill_worker.splat.formats import sog, sog_files
from splatmill_worker.splat.formats.contents import NO_OFFSET, Contents, Offset
from splatmill_worker.splat.formats.streamed_sog import (
    INDEX,
    MAX_INDEX_BYTES,
    Document,
    divided_visible,
    encoded,
    finest,
    joined,
    unreadable,
)
from splatmill_worker.splat.gaussians import Gaussians

WHAT = "levels of detail"
"""What messages say that a file was read as."""

MAX_LIST_BYTES = 2**23
"""Bytes of the list of files at most. A chunk of 65,536 Gaussians has eight files, which take some 600."""


def write(path: Path, gaussians: Gaussians, *, offset: Offset = NO_OFFSET, antialiased: bool = False) -> int:
    """Write what `streamed_sog.write` does to one file; returns how many Gaussians level 0 and the surroundings have.

    The file is replaced atomically and synced. The same model gives the same bytes.
    """
    model, count = divided_visible(gaussians)
    with replacing(path, sync=True) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_STORED) as archive:
        for name, content in encoded(model, offset=offset, antialiased=antialiased):
            packing = zipfile.ZIP_DEFLATED if name == INDEX else zipfile.ZIP_STORED
            archive.writestr(sog.member(name), content, packing)
    return count


def read(path: Path, *, list_bytes: int = MAX_LIST_BYTES) -> Contents:
    """Read level 0 and the environment. The files may lie in a folder of the archive, and be compressed.

    list_bytes: bytes of the archive's list of files at most.

    Raises ModelUnreadable for any other file, and FileNotFoundError where there is none.
    """
    with unreadable(path, WHAT), opened(path, list_bytes=list_bytes) as document:
        return joined([document.part(name) for name in finest(document.index)])


@contextmanager
def opened(path: Path, *, list_bytes: int = MAX_LIST_BYTES) -> Iterator[Document]:
    """The model of a `.lod.zip`, until the context ends. Raises what `unreadable` turns into ModelUnreadable."""
    with (
        BoundedReads(io.FileIO(path), list_bytes, _list_too_long) as file,
        zipfile.ZipFile(cast(IO[bytes], file)) as archive,
    ):
        file.most = None  # each member is compared with what is expected of it
        folder = _folder(archive)
        index = sog_files.contents(sog_files.Members(archive, folder), INDEX, MAX_INDEX_BYTES)

        def part(name: str) -> sog_files.Files:
            return sog_files.Members(archive, f"{folder}{PurePosixPath(name).parent}/")

        yield Document(json.loads(index), part)


def _folder(archive: zipfile.ZipFile) -> str:
    """The outermost folder with an index, with a slash at its end. Raises ValueError for an archive without one."""
    names = [name for name in archive.namelist() if PurePosixPath(name).name == INDEX]
    if not names:
        raise ValueError(f"it holds no {INDEX}")
    return min(names, key=lambda name: (name.count("/"), name)).removesuffix(INDEX)


def _list_too_long(size: int) -> ValueError:
    return ValueError(f"its list of files has {size} bytes, more than are read")
