"""The formats by suffix: `read` and `write` choose the one of a path. `splatmill.schema.files.formats` lists them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from splatmill.schema.files.formats import MODEL_FORMATS, format_of
from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.splat.formats import (
    compressed_ply,
    glb,
    gltf,
    ksplat,
    ply,
    sog,
    splat,
    spz,
    streamed_sog,
    streamed_zip,
    tileset,
)
from splatmill_worker.splat.formats.contents import NO_OFFSET, Contents, Offset
from splatmill_worker.splat.gaussians import Gaussians

Reader = Callable[[Path], Contents]


class Writer(Protocol):
    """Writes Gaussians in the frame of the standard .ply and returns how many; see `write`."""

    def __call__(
        self, path: Path, gaussians: Gaussians, *, offset: Offset = ..., antialiased: bool = ...
    ) -> int: ...


@dataclass(frozen=True)
class Codec:
    """The functions of a format; None where it is not read, or not written.

    files: all files of a model that was written to a folder of files.
    """

    read: Reader | None
    write: Writer | None
    files: Callable[[Path], list[Path]] | None = None


def _read_ply(path: Path) -> Contents:
    """A .ply of either form: many compressed ones carry no more than this suffix."""
    document = ply.parsed(path)
    return (
        compressed_ply.decode(path, document)
        if compressed_ply.is_compressed(document)
        else ply.decode(path, document)
    )


CODECS: dict[str, Codec] = {
    ".ply": Codec(_read_ply, ply.write),
    ".compressed.ply": Codec(_read_ply, compressed_ply.write),
    ".spz": Codec(spz.read, spz.write),
    ".splat": Codec(splat.read, None),
    ".ksplat": Codec(ksplat.read, None),
    ".sog": Codec(sog.read, sog.write),
    "meta.json": Codec(sog.read, None),
    "lod-meta.json": Codec(streamed_sog.read, streamed_sog.write, streamed_sog.files),
    ".lod.zip": Codec(streamed_zip.read, streamed_zip.write),
    ".glb": Codec(glb.read, glb.write),
    "tileset.json": Codec(None, tileset.write, tileset.files),
}
"""One for each of `MODEL_FORMATS`; a test compares them."""


def reader(path: Path) -> Reader:
    """The function that reads a file, by its suffix. Raises ModelUnreadable for a suffix that is not read."""
    model_format = format_of(path.name)
    function = CODECS[model_format.suffix].read if model_format is not None else None
    if function is None:
        known = ", ".join(suffix for suffix, of in MODEL_FORMATS.items() if of.readable)
        raise ModelUnreadable(f"{path.name} is of a format that is not read. Those that are: {known}.")
    return function


def writer(path: Path) -> Writer:
    """The function that writes a file, by its suffix. Raises ModelUnreadable for a suffix that is not written."""
    model_format = format_of(path.name)
    function = CODECS[model_format.suffix].write if model_format is not None else None
    if function is None:
        known = ", ".join(suffix for suffix, of in MODEL_FORMATS.items() if of.writable)
        raise ModelUnreadable(f"{path.name} is of a format that is not written. Those that are: {known}.")
    return function


def read(path: Path) -> Contents:
    """Read the model in a file of any readable format, which the suffix names.

    Raises ModelUnreadable for a damaged file, what is no regular file, or an unknown suffix, and FileNotFoundError
    where there is no file.
    """
    function = reader(path)
    if path.exists() and not path.is_file():  # a pipe would keep its reader waiting
        raise ModelUnreadable(f"{path.name} is not a regular file.")
    return function(path)


def size(path: Path) -> int:
    """The bytes of a model that was written to `path`, those of the files beside it included."""
    model_format = format_of(path.name)
    files = None if model_format is None else CODECS[model_format.suffix].files
    parts = [path] if files is None else files(path)
    return sum(part.stat().st_size for part in parts)


def write(
    path: Path,
    gaussians: Gaussians,
    *,
    offset: Offset = NO_OFFSET,
    antialiased: bool = False,
    up: gltf.Up | None = None,
    to_earth: npt.NDArray[np.float64] | None = None,
) -> int:
    """Write Gaussians to a file whose suffix names the format, and return how many it holds.

    gaussians: in the frame of the standard .ply, of any dtype and on any device.
    offset, antialiased: as in `Contents`, stored where the format has a place for them.
    up: a unit vector, by which a `.glb` or a tileset is shown upright; None where it is not known, and -y is taken.
    to_earth: the place of a tileset, as of `tileset.write`.

    Rows with a non-finite parameter and rows with an opacity under MIN_OPACITY are left out. The file is replaced
    atomically. Raises ModelUnreadable for a suffix that is not written, and OSError.
    """
    function = writer(path)
    if function is glb.write:
        return glb.write(path, gaussians, offset=offset, antialiased=antialiased, up=up)
    if function is tileset.write:
        return tileset.write(
            path, gaussians, offset=offset, antialiased=antialiased, up=up, to_earth=to_earth
        )
    return function(path, gaussians, offset=offset, antialiased=antialiased)
