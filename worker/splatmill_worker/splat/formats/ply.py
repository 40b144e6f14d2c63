"""The standard 3D Gaussian `.ply`: written in one fixed layout, read from any tool's file by property name."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData, PlyElement, PlyParseError, PlyProperty

from splatmill.files import replacing
from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.readers import ply_document, reader_memory
from splatmill_worker.splat.formats import ply_columns, ply_comments
from splatmill_worker.splat.formats.contents import (
    NO_OFFSET,
    Contents,
    Offset,
    gathered,
    left_out,
    unit,
    visible,
)
from splatmill_worker.splat.gaussians import Gaussians

PIECE = 16_384
"""Gaussians that are read or written at a time, so that memory holds no second model."""

COPIES = 3
"""Times the memory of the parameters that `read` takes of a binary file: they, and the file that is mapped."""

COMPRESSED_ELEMENTS = ("chunk", "sh")
"""Elements of a compressed .ply besides its vertices."""


def property_names(degree: int) -> list[str]:
    """Vertex properties of the standard layout at an SH degree, in file order."""
    rest = 3 * ((degree + 1) ** 2 - 1)
    return [
        *("x", "y", "z", "nx", "ny", "nz"),
        *(f"f_dc_{i}" for i in range(3)),
        *(f"f_rest_{i}" for i in range(rest)),
        "opacity",
        *(f"scale_{i}" for i in range(3)),
        *(f"rot_{i}" for i in range(4)),
    ]


def write(
    path: Path,
    gaussians: Gaussians,
    *,
    offset: Offset = NO_OFFSET,
    antialiased: bool = False,
    degree: int | None = None,
    comments: tuple[str, ...] = (),
) -> int:
    """Write `gaussians` as binary little-endian float32; returns how many were written.

    Rows with a non-finite parameter and rows with an opacity under MIN_OPACITY are left out. Quaternions are
    normalised. offset, antialiased: of `Contents`, stored as comments of the header. degree: SH degree of the
    file (some viewers read degree 3 only); that of the Gaussians where None. comments: lines of the header.
    The file is replaced atomically and synced.
    """
    names = property_names(gaussians.degree if degree is None else degree)
    n = sum(visible(piece).count for piece in _pieces(gaussians, degree))
    document = PlyData(
        [PlyElement("vertex", [PlyProperty(name, "float") for name in names], n)],
        byte_order="<",
        comments=[*comments, *ply_comments.comments_of(offset, antialiased)],
    )
    with replacing(path, sync=True) as part, part.open("wb") as stream:
        stream.write(document.header.encode("ascii") + b"\n")
        for piece in _pieces(gaussians, degree):
            stream.write(_rows(visible(piece)))
    return n


def _pieces(gaussians: Gaussians, degree: int | None) -> Iterator[Gaussians]:
    """PIECE rows at a time, at an SH degree where one is given."""
    for first in range(0, gaussians.count, PIECE):
        piece = gaussians.select(slice(first, first + PIECE))
        yield piece if degree is None else piece.padded(degree)


def _rows(gaussians: Gaussians) -> bytes:
    """The vertices of a file, in the order of `property_names`."""
    columns = torch.cat(
        [
            gaussians.means,
            torch.zeros(gaussians.count, 3),
            gaussians.sh[:, 0],
            gaussians.sh[:, 1:].transpose(1, 2).flatten(1),  # channel-major: all R, then all G, then all B
            gaussians.logit_opacities[:, None],
            gaussians.log_scales,
            unit(gaussians.quats),
        ],
        dim=1,
    )
    return columns.numpy().astype("<f4", copy=False).tobytes()


def read(path: Path) -> Contents:
    """Read any tool's 3D Gaussian `.ply` (binary of either byte order, or text) as float32 tensors.

    Properties are found by name; normals and unknown properties are ignored. Colours as red, green and blue, Gaussians
    of two scales, and harmonics above degree 3 are read too, with notes in the contents.

    Rows with a non-finite value are left out. Raises ModelUnreadable for any other file, and FileNotFoundError where
    there is none.
    """
    return decode(path, parsed(path))


def decode(path: Path, document: PlyData) -> Contents:
    """What `read` returns, of a file that was parsed already."""
    vertex = document["vertex"]
    rest = sum(p.name.startswith("f_rest_") for p in vertex.properties)
    degree = ply_columns.degree_of(rest)
    if degree is None:
        raise ModelUnreadable(
            f"{path.name} has {rest} f_rest properties; SH degrees 0 to 4 have 0, 9, 24, 45 or 72."
        )
    check_count(path, vertex.count, degree, reader_memory.COPIES if document.text else COPIES)
    notes = dict[str, None]()

    def pieces() -> Iterator[Gaussians]:
        for first in range(0, max(1, vertex.count), PIECE):
            rows = PlyElement.describe(vertex.data[first : first + PIECE], "vertex")
            gaussians, said = ply_columns.gaussians_of(rows)
            notes.update(dict.fromkeys(said))
            yield _finite(gaussians)

    try:
        gaussians = gathered(vertex.count, min(degree, 3), pieces())
    except ValueError as error:
        raise ModelUnreadable(f"{path.name} is not a 3D Gaussian .ply: {error}.") from error
    return Contents(
        gaussians,
        ply_comments.offset_of(path, document),
        ply_comments.antialiased_of(document),
        (
            *notes,
            *left_out(vertex.count - gaussians.count, vertex.count),
            *ply_comments.unknown_modes(document),
        ),
    )


def _finite(piece: Gaussians) -> Gaussians:
    """The rows of `Gaussians.finite`. By NumPy, as `gathered` copies."""
    values = [value.numpy() for value in piece]
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        keep = np.linalg.norm(piece.quats.numpy(), axis=1) > 0
    for value in values:
        keep &= np.isfinite(value).all(axis=tuple(range(1, value.ndim)))
    return piece if keep.all() else Gaussians(*(torch.from_numpy(value[keep]) for value in values))


def check_count(path: Path, count: int, degree: int, copies: int = reader_memory.COPIES) -> None:
    """Raise ModelUnreadable for more Gaussians than the file, or the memory, can hold.

    copies: times the memory of the parameters that reading takes.
    """
    try:
        reader_memory.check_gaussians(count, degree, path.stat().st_size, copies)
    except ValueError as error:
        raise ModelUnreadable(f"{path.name} could not be read as a .ply file: {error}.") from error


def parsed(path: Path) -> PlyData:
    """The elements of Gaussians in a .ply file of either form. Raises ModelUnreadable, and FileNotFoundError."""
    try:
        return ply_document.read(path, "vertex", *COMPRESSED_ELEMENTS)
    except FileNotFoundError:
        raise
    except (PlyParseError, ValueError, OSError, IndexError, KeyError) as error:
        raise ModelUnreadable(f"{path.name} could not be read as a .ply file: {error}.") from error
