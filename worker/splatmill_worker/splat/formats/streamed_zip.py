"""Streamed SOG in one file: a `lod-meta.json` and all that it names, in a .zip that viewers read piece by piece.

The files of a chunk lie together and are stored as they are, and the index comes last, before the archive's list of its
files. So one range of bytes, from the end, says where everything is, and one more brings each chunk.
"""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path, PurePosixPath
from typing import IO, cast

from splatmill.files import replacing
from splatmill_worker.errors import ModelUnreadable, UnusablePicture
from splatmill_worker.images.archives.archive import DAMAGED, BoundedReads
from splatmill_worker.splat.formats import sog, sog_files, streamed_sog
from splatmill_worker.splat.formats.contents import NO_OFFSET, Contents, Offset
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.wording import plain

MAX_LIST_BYTES = 2**23
"""Bytes of the list of files at most. A chunk of 65,536 Gaussians has eight files, which take some 600."""


def write(path: Path, gaussians: Gaussians, *, offset: Offset = NO_OFFSET, antialiased: bool = False) -> int:
    """Write what `streamed_sog.write` does to one file; returns how many Gaussians level 0 and the surroundings have.

    The file is replaced atomically and synced. The same model gives the same bytes.
    """
    model, count = streamed_sog.divided_visible(gaussians)
    with replacing(path, sync=True) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_STORED) as archive:
        for name, content in streamed_sog.encoded(model, offset=offset, antialiased=antialiased):
            packing = zipfile.ZIP_DEFLATED if name == streamed_sog.INDEX else zipfile.ZIP_STORED
            archive.writestr(sog.member(name), content, packing)
    return count


def read(path: Path, *, list_bytes: int = MAX_LIST_BYTES) -> Contents:
    """Read level 0 and the environment. The files may lie in a folder of the archive, and be compressed.

    list_bytes: bytes of the archive's list of files at most.

    Raises ModelUnreadable for any other file, and FileNotFoundError where there is none.
    """
    try:
        with (
            BoundedReads(io.FileIO(path), list_bytes, _list_too_long) as file,
            zipfile.ZipFile(cast(IO[bytes], file)) as archive,
        ):
            file.most = None  # each member is compared with what is expected of it
            folder = _folder(archive)
            members = sog_files.Members(archive, folder)
            index = sog_files.contents(members, streamed_sog.INDEX, streamed_sog.MAX_INDEX_BYTES)
            return streamed_sog.joined(
                [
                    sog_files.Members(archive, f"{folder}{PurePosixPath(name).parent}/")
                    for name in streamed_sog.finest(json.loads(index))
                ]
            )
    except FileNotFoundError:
        raise
    except UnusablePicture as error:
        raise ModelUnreadable(f"{path.name} cannot be read: {error.message}") from error
    except (*DAMAGED, *streamed_sog.DAMAGE) as error:
        raise ModelUnreadable(
            f"{path.name} could not be read as levels of detail: {plain(error)}."
        ) from error


def _folder(archive: zipfile.ZipFile) -> str:
    """The outermost folder with an index, with a slash at its end. Raises ValueError for an archive without one."""
    names = [name for name in archive.namelist() if PurePosixPath(name).name == streamed_sog.INDEX]
    if not names:
        raise ValueError(f"it holds no {streamed_sog.INDEX}")
    return min(names, key=lambda name: (name.count("/"), name)).removesuffix(streamed_sog.INDEX)


def _list_too_long(size: int) -> ValueError:
    return ValueError(f"its list of files has {size} bytes, more than are read")
