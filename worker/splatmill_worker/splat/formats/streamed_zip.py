"""Streamed SOG in one file: a `lod-meta.json` and all that it names, in a .zip that viewers read piece by piece.

The files of a chunk lie together and are stored as they are, and the index comes last, before the archive's list of its
files. So one range of bytes, from the end, tells where everything is, and one more brings each chunk.
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import IO, cast

from splatmill.files import replacing
from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.images.archives.archive import DAMAGED, BoundedReads
from splatmill_worker.splat.formats import streamed_sog
from splatmill_worker.splat.formats.contents import NO_OFFSET, Contents, Offset
from splatmill_worker.splat.formats.sog import member
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.wording import plain

INDEX = "lod-meta.json"

MAX_LIST_BYTES = 2**23
"""Bytes of the list of files at most: of some 100,000, which are chunks for 700 million Gaussians."""

MAX_GROWTH = 2
"""Bytes of the unpacked files over those of the archive, at most, beyond an index: images of SOG do not get smaller."""


def write(path: Path, gaussians: Gaussians, *, offset: Offset = NO_OFFSET, antialiased: bool = False) -> int:
    """Write what `streamed_sog.write` does to one file; returns how many Gaussians level 0 and the surroundings have.

    The file is replaced atomically and synced. The same model gives the same bytes.
    """
    with TemporaryDirectory(dir=_made(path.parent), prefix=".levels-") as folder:
        index = Path(folder) / INDEX
        count = streamed_sog.write(index, gaussians, offset=offset, antialiased=antialiased)
        with replacing(path, sync=True) as part, zipfile.ZipFile(part, "w") as archive:
            for file in streamed_sog.files(index)[1:]:
                archive.writestr(member(file.relative_to(folder).as_posix()), file.read_bytes())
            archive.writestr(member(INDEX), index.read_bytes(), zipfile.ZIP_DEFLATED)
    return count


def read(path: Path) -> Contents:
    """Read level 0 and the environment. The files may lie in a folder of the archive, and be compressed.

    Raises ModelUnreadable for any other file, and FileNotFoundError where there is none.
    """
    try:
        with (
            BoundedReads(io.FileIO(path), MAX_LIST_BYTES, _list_too_long) as file,
            zipfile.ZipFile(cast(IO[bytes], file)) as archive,
        ):
            file.most = None  # the sizes of all files are added up first
            index = _index(archive, path.stat().st_size)
            with TemporaryDirectory(prefix="levels-") as folder:
                archive.extractall(folder)
                return streamed_sog.read(Path(folder) / index)
    except FileNotFoundError:
        raise
    except (*DAMAGED, OSError, RuntimeError, ValueError) as error:
        raise ModelUnreadable(
            f"{path.name} could not be read as levels of detail: {plain(error)}."
        ) from error


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _index(archive: zipfile.ZipFile, size: int) -> str:
    """The name of the index, which is the one in the outermost folder. Raises ValueError for an archive without one."""
    unpacked = sum(info.file_size for info in archive.infolist())
    if unpacked > MAX_GROWTH * size + streamed_sog.MAX_INDEX_BYTES:
        raise ValueError(f"its files have {unpacked} bytes unpacked, and the archive has {size}")
    names = [name for name in archive.namelist() if PurePosixPath(name).name == INDEX]
    if not names:
        raise ValueError(f"it holds no {INDEX}")
    return min(names, key=lambda name: (name.count("/"), name))


def _list_too_long(size: int) -> ValueError:
    return ValueError(f"its list of files has {size} bytes, and {MAX_LIST_BYTES} at most are read")
