"""The compressed `.ply` of PlayCanvas and SuperSplat: 16 bytes a Gaussian, and a byte per coefficient of its harmonics.

Each chunk of 256 Gaussians has the ranges of its positions, logarithmic scales and colours as float32. A Gaussian holds
fractions of these ranges in 11, 10 and 11 bits (positions, scales) or 8 (colours), its opacity in 8, and the three
smaller components of its quaternion in 10 each. Harmonics above the DC term lie between -4 and 4, in steps of 1/32.
Layout: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/ply/ (the compressed form).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from plyfile import PlyData, PlyElement
from torch import Tensor

from splatmill.files import atomic_write
from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.kernels.morton import morton_order
from splatmill_worker.splat.formats import ply, ply_columns, ply_comments
from splatmill_worker.splat.formats.contents import (
    MIN_OPACITY,
    NO_OFFSET,
    Contents,
    Offset,
    logits,
)
from splatmill_worker.splat.gaussians import SH_C0, Gaussians

CHUNK = 256
"""Gaussians that share their ranges."""

MOST_LOG_SCALE = 20.0
"""Logarithmic scales are clamped to plus and minus this, as other writers of the format do."""

HARMONICS_RANGE = 4.0
"""Harmonics are clamped to plus and minus this."""

_AXES = ("x", "y", "z")
_RANGES = [
    f"{end}_{what}{axis}"
    for what, axes in (("", _AXES), ("scale_", _AXES), ("", ("r", "g", "b")))
    for end in ("min", "max")
    for axis in axes
]
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_OTHERS = torch.tensor([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


def encode(gaussians: Gaussians, *, offset: Offset = NO_OFFSET, antialiased: bool = False) -> bytes:
    """The file as bytes, with the harmonics that `gaussians` have: pad them to degree 0 for 16 bytes a Gaussian.

    Rows with a non-finite parameter and rows with an opacity under MIN_OPACITY are left out, and the others are put
    into the order of a space-filling curve, so that the Gaussians of a chunk lie near each other.
    """
    return _encoded(_ordered(gaussians), offset, antialiased)


def write(path: Path, gaussians: Gaussians, *, offset: Offset = NO_OFFSET, antialiased: bool = False) -> int:
    """Write what `encode` gives; returns how many Gaussians were written.

    offset, antialiased: of `Contents`, stored as comments of the header. The file is replaced atomically.
    Raises OSError.
    """
    ordered = _ordered(gaussians)
    atomic_write(path, _encoded(ordered, offset, antialiased))
    return ordered.count


def is_compressed(document: PlyData) -> bool:
    """Whether a parsed .ply is of this form: its chunks are an element of their own."""
    return any(element.name == "chunk" for element in document.elements)


def read(path: Path) -> Contents:
    """Read a compressed `.ply`. Files of older writers, whose chunks have no range of colours, are read too.

    Raises ModelUnreadable for any other file, and FileNotFoundError where there is none.
    """
    return decode(path, ply.parsed(path))


def decode(path: Path, document: PlyData) -> Contents:
    """What `read` returns, of a file that was parsed already."""
    elements = {element.name: element for element in document.elements}
    sh = elements.get("sh")
    colors_too = "chunk" in elements and "min_r" in elements["chunk"]
    chunk = _element(path, elements, "chunk", _RANGES if colors_too else _RANGES[:12])
    vertex = _element(path, elements, "vertex", _PACKED)
    n = vertex.count
    if chunk.count < -(-n // CHUNK):
        raise ModelUnreadable(
            f"{path.name} has {n} Gaussians and {chunk.count} chunks of {CHUNK}, which are too few."
        )
    rest = 0 if sh is None else len(sh.properties)
    degree = ply_columns.degree_of(rest)
    if sh is not None and (not degree or sh.count != n):
        raise ModelUnreadable(
            f"{path.name} has {rest} harmonics of {sh.count} Gaussians, where 9, 24, 45 or 72 of {n} are possible."
        )
    ply.check_count(path, n, degree or 0)
    position, rotation, scale, color = (np.asarray(vertex[name]).astype(np.uint32) for name in _PACKED)
    rgba = _unpacked(color, 8, 8, 8, 8)
    rgb = _spread(rgba[:, :3], chunk, _RANGES[12:]) if colors_too else rgba[:, :3]
    coefficients = [((rgb - 0.5) / SH_C0)[:, None]]
    if rest:
        sh = _element(path, elements, "sh", [f"f_rest_{i}" for i in range(rest)])
        names = ply_columns.kept_rest(rest)
        levels = np.stack([np.asarray(sh[name], np.float32) for name in names], axis=1)
        # The middle of each step; the two outermost levels stand for the ends of the range.
        values = np.where(levels == 0, -128.0, np.where(levels == 255, 128.0, levels - 127.5))
        table = torch.from_numpy(values.astype(np.float32) * np.float32(HARMONICS_RANGE / 128.0))
        coefficients.append(table.reshape(n, 3, len(names) // 3).transpose(1, 2))
    gaussians = Gaussians(
        means=_spread(_unpacked(position, 11, 10, 11), chunk, _RANGES[:6]),
        log_scales=_spread(_unpacked(scale, 11, 10, 11), chunk, _RANGES[6:12]),
        quats=_quats(rotation),
        logit_opacities=logits(rgba[:, 3]),
        sh=torch.cat(coefficients, dim=1),
    )
    return Contents.of(
        gaussians,
        ply_comments.offset_of(path, document),
        ply_comments.antialiased_of(document),
        (*ply_columns.rest_notes(degree or 0), *ply_comments.unknown_modes(document)),
    )


def _ordered(gaussians: Gaussians) -> Gaussians:
    gaussians = gaussians.map(lambda value: value.detach().to("cpu", torch.float32))
    keep = gaussians.finite() & (gaussians.logit_opacities >= torch.tensor(MIN_OPACITY).logit())
    rows = keep.nonzero()[:, 0]
    rows = rows[morton_order(gaussians.means[rows])]
    return gaussians.select(rows)


def _encoded(gaussians: Gaussians, offset: Offset, antialiased: bool) -> bytes:
    """The file that holds the rows of `gaussians` in their order."""
    ranges = []
    fractions = []
    for values in (
        gaussians.means,
        gaussians.log_scales.clamp(-MOST_LOG_SCALE, MOST_LOG_SCALE),
        gaussians.sh[:, 0] * SH_C0 + 0.5,
    ):
        low, high, fraction = _in_chunks(values)
        ranges += [low, high]
        fractions.append(fraction)
    packed = torch.stack(
        [
            _three(fractions[0]),
            _rotation(gaussians.quats),
            _three(fractions[1]),
            _color(fractions[2], torch.sigmoid(gaussians.logit_opacities)),
        ],
        dim=1,
    )
    elements = [
        ("chunk", "float", _RANGES, torch.cat(ranges, dim=1).numpy().astype("<f4", copy=False)),
        ("vertex", "uint", list(_PACKED), packed.numpy().astype("<u4")),
    ]
    rest = gaussians.sh.shape[1] - 1
    if rest:
        steps = gaussians.sh[:, 1:].transpose(1, 2).flatten(1) * (128.0 / HARMONICS_RANGE)
        levels = (steps.floor() + 128).clamp(0, 255).to(torch.uint8).numpy()
        elements.append(("sh", "uchar", [f"f_rest_{i}" for i in range(3 * rest)], levels))
    comments = ["Made by Splatmill", *ply_comments.comments_of(offset, antialiased)]
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in comments)]
    for name, kind, properties, rows in elements:
        header += [f"element {name} {len(rows)}", *(f"property {kind} {label}" for label in properties)]
    return b"".join(
        ["\n".join([*header, "end_header\n"]).encode(), *(rows.tobytes() for *_, rows in elements)]
    )


def _in_chunks(values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Lows and highs [C, 3] of the chunks of `values` [N, 3], and where the values lie between them, 0 to 1 [N, 3]."""
    n = len(values)
    missing = -n % CHUNK
    if missing:
        values = torch.cat([values, values[-1:].expand(missing, 3)])
    chunks = values.reshape(-1, CHUNK, 3)
    low, high = torch.aminmax(chunks, dim=1)
    extent = high - low
    fractions = (chunks - low[:, None]) / torch.where(extent > 0, extent, 1.0)[:, None]
    return low, high, fractions.reshape(-1, 3)[:n]


def _level(fractions: Tensor, bits: int) -> Tensor:
    """Whole numbers of `bits` bits, int64, for values from 0 to 1."""
    most = (1 << bits) - 1
    return (fractions * most + 0.5).to(torch.int64).clamp(0, most)


def _three(fractions: Tensor) -> Tensor:
    x, y, z = fractions.unbind(dim=1)
    return (_level(x, 11) << 21) | (_level(y, 10) << 11) | _level(z, 11)


def _color(rgb: Tensor, alpha: Tensor) -> Tensor:
    r, g, b = _level(rgb, 8).unbind(dim=1)
    return (r << 24) | (g << 16) | (b << 8) | _level(alpha, 8)


def _rotation(quats: Tensor) -> Tensor:
    """The index of the largest component in two bits, then the other three, of wxyz, in ten bits each."""
    quats = torch.nn.functional.normalize(quats, dim=1, eps=0.0)
    largest = quats.abs().argmax(dim=1, keepdim=True)
    sign = torch.where(quats.gather(1, largest) < 0, -1.0, 1.0)
    others = quats.gather(1, _OTHERS[largest[:, 0]]) * sign
    a, b, c = _level((others * 0.5**0.5 + 0.5).clamp(0, 1), 10).unbind(dim=1)
    return (largest[:, 0] << 30) | (a << 20) | (b << 10) | c


def _element(path: Path, elements: dict[str, PlyElement], kind: str, names: Sequence[str]) -> PlyElement:
    """An element that has the properties `names`. Raises ModelUnreadable."""
    element = elements.get(kind)
    present = {p.name for p in element.properties} if element is not None else set()
    missing = [name for name in names if name not in present]
    if element is None or missing:
        raise ModelUnreadable(
            f"{path.name} is not a compressed .ply: its element {kind} lacks {', '.join(missing)}."
        )
    return element


def _unpacked(words: npt.NDArray[np.uint32], *bits: int) -> Tensor:
    """[N, len(bits)] values from 0 to 1; the first lie in the highest bits."""
    columns = []
    shift = 32
    for width in bits:
        shift -= width
        columns.append(((words >> shift) & ((1 << width) - 1)).astype(np.float32) / ((1 << width) - 1))
    return torch.from_numpy(np.stack(columns, axis=1))


def _spread(fractions: Tensor, chunk: PlyElement, names: list[str]) -> Tensor:
    """Fractions [N, 3] between the lows and highs of their chunks, whose properties are `names`."""
    n = len(fractions)
    table = np.stack([np.asarray(chunk[name], np.float32) for name in names], axis=1)
    rows = torch.from_numpy(np.repeat(table, CHUNK, axis=0)[:n])
    low, high = rows[:, :3], rows[:, 3:]
    return low * (1 - fractions) + high * fractions


def _quats(words: npt.NDArray[np.uint32]) -> Tensor:
    others = (_unpacked((words << 2).astype(np.uint32), 10, 10, 10) - 0.5) * 2**0.5
    largest = torch.from_numpy((words >> 30).astype(np.int64))
    quats = torch.empty(len(words), 4)
    quats.scatter_(1, _OTHERS[largest], others)
    quats.scatter_(1, largest[:, None], (1 - (others * others).sum(dim=1, keepdim=True)).clamp(min=0).sqrt())
    return quats
