"""Niantic's `.spz`: about 20 bytes a Gaussian with harmonics. Versions 2, 3 (gzip) and 4 (zstd) are read, 3 is written.

Positions are 24-bit fixed-point numbers, logarithmic scales have steps of 1/16 from -10, opacities and colours 8 bits,
the three smaller components of a quaternion 10 bits, harmonics 8 bits from -1 to 1, of which a writer fills fewer so
that they compress. The frame is right-up-back. Layout: https://github.com/nianticlabs/spz (README).
"""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatmill.files import atomic_write
from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.kernels.morton import morton_order
from splatmill_worker.readers.reader_memory import check, check_gaussians
from splatmill_worker.splat.formats.contents import NO_OFFSET, Contents, Offset, logits, unit, visible
from splatmill_worker.splat.formats.expansion import Gunzip, unzstd
from splatmill_worker.splat.formats.frames import turned_about_x
from splatmill_worker.splat.formats.ply_columns import rest_notes
from splatmill_worker.splat.gaussians import Gaussians

MAGIC = b"NGSP"

SH_BITS = 6
"""Bits of a harmonic that are filled. The libraries of others fill 5 and 4 (decisions: SH_BITS)."""

POSITIONS_PER_GAUSSIAN = 20
"""Steps of a position within the longest standard deviation of small Gaussians (the first percentile): so many that the
steps cannot be seen (decisions: POSITIONS_PER_GAUSSIAN)."""

_GZIP = b"\x1f\x8b"
_COLOR = 0.15  # colours are stored as 0.5 + 0.15 dc, which leaves room above 1 and below 0
_ANTIALIASED = 1
_EXTENDED = 2
_FRAME_EXTENSION = 0xADBE0003
_RDF, _RUB = 6, 4  # numbers of the frames in that extension
_RESTS = {0: 0, 1: 3, 2: 8, 3: 15, 4: 24}

Bytes = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class _Header:
    """count: number of Gaussians. The others are named as in the format."""

    version: int
    count: int
    degree: int
    fraction_bits: int
    flags: int

    def widths(self) -> tuple[int, ...]:
        """Bytes a Gaussian of positions, opacities, colours, scales, rotations and harmonics, in file order."""
        return 9, 1, 3, 3, 3 if self.version < 3 else 4, 3 * _RESTS[self.degree]


def write(
    path: Path,
    gaussians: Gaussians,
    *,
    offset: Offset = NO_OFFSET,
    antialiased: bool = False,
    sh_bits: int = SH_BITS,
) -> int:
    """Write version 3, in the order of a space-filling curve; returns how many Gaussians were written.

    Rows with a non-finite parameter and rows with an opacity under MIN_OPACITY are left out. offset: not stored, the
    format has no place for it. antialiased: a flag of the file. sh_bits: of a harmonic, 1 to 8; fewer make a smaller
    file. The file is replaced atomically. Raises OSError.
    """
    gaussians = visible(gaussians)
    atomic_write(path, encoded(gaussians, antialiased=antialiased, sh_bits=sh_bits))
    return gaussians.count


def encoded(gaussians: Gaussians, *, antialiased: bool = False, sh_bits: int = SH_BITS) -> bytes:
    """The file of `gaussians`, all of which are finite, as `write` writes it."""
    gaussians = turned_about_x(gaussians.select(morton_order(gaussians.means)))
    bits = _fraction_bits(gaussians)
    fixed = (gaussians.means.double() * 2**bits).round().clamp(-(2**23), 2**23 - 1).to(torch.int32)
    streams = [
        fixed.numpy().astype("<i4").view(np.uint8).reshape(-1, 4)[:, :3],
        _levels(torch.sigmoid(gaussians.logit_opacities) * 255.0),
        _levels(gaussians.sh[:, 0] * (255.0 * _COLOR) + 127.5),
        _levels((gaussians.log_scales + 10.0) * 16.0),
        _packed_rotations(unit(gaussians.quats)).view(np.uint8),
        _packed_harmonics(gaussians.sh[:, 1:], sh_bits),
    ]
    head = MAGIC + struct.pack(
        "<IIBBBB", 3, gaussians.count, gaussians.degree, bits, _ANTIALIASED if antialiased else 0, 0
    )
    packer = zlib.compressobj(wbits=31)
    pieces = [packer.compress(head), *(packer.compress(s.tobytes()) for s in streams), packer.flush()]
    return b"".join(pieces)


def read(path: Path) -> Contents:
    """Read a file of version 2, 3 or 4. Harmonics of degree 4 are left out. `antialiased` is the flag of the file.

    Raises ModelUnreadable for any other file, and FileNotFoundError where there is none.
    """
    size = path.stat().st_size
    try:
        check("reading it", size, size)
        header, streams, frame = _streams(path.read_bytes())
    except ValueError as error:
        raise ModelUnreadable(f"{path.name} could not be read as an .spz file: {error}.") from error
    positions, alphas, colors, scales, rotations, harmonics = (
        stream.reshape(header.count, width) for stream, width in zip(streams, header.widths(), strict=True)
    )
    sh = torch.cat(
        [
            (_floats(colors) / 255.0 - 0.5)[:, None] / _COLOR,
            ((_floats(harmonics) - 128.0) / 128.0).reshape(header.count, _RESTS[header.degree], 3)[:, :15],
        ],
        dim=1,
    )
    gaussians = Gaussians(
        means=_positions(positions, header.fraction_bits),
        log_scales=_floats(scales) / 16.0 - 10.0,
        quats=_first_three(rotations) if header.version < 3 else _smallest_three(rotations),
        logit_opacities=logits(_floats(alphas)[:, 0] / 255.0),
        sh=sh,
    )
    if frame == _RUB:
        gaussians = turned_about_x(gaussians)
    antialiased = bool(header.flags & _ANTIALIASED)
    return Contents.of(gaussians, antialiased=antialiased, notes=rest_notes(header.degree))


def _parsed(head: bytes, size: int) -> _Header:
    """The header, of a file of `size` bytes. Raises ValueError."""
    if len(head) < 16 or not head.startswith(MAGIC):
        raise ValueError(f"it does not begin with {MAGIC.decode()!r}, neither plainly nor in gzip")
    header = _Header(*struct.unpack_from("<IIBBB", head, 4))
    if header.version not in (2, 3, 4):
        raise ValueError(f"its version is {header.version}, and 2, 3 and 4 are known")
    if header.degree not in _RESTS:
        raise ValueError(f"its harmonics are of degree {header.degree}, and 0 to 4 are known")
    if header.fraction_bits > 24:
        raise ValueError(f"its positions have {header.fraction_bits} of 24 bits after the point")
    check_gaussians(header.count, header.degree, size)
    return header


def _streams(data: bytes) -> tuple[_Header, list[Bytes], int]:
    """The header, the six streams and the frame of a file. Raises ValueError."""
    pieces: Gunzip | _Pieces | _Frames
    if data.startswith(_GZIP):
        pieces = Gunzip(data)
        header = _parsed(pieces.take(16), len(data))
    else:
        header = _parsed(data, len(data))
        pieces = _Pieces(data, 16) if header.version < 4 else _Frames(data, header)
    streams = [np.frombuffer(pieces.take(width * header.count), np.uint8) for width in header.widths()]
    return header, streams, _frame(pieces.rest() if header.flags & _EXTENDED else b"")


def _frame(extensions: bytes) -> int:
    """The frame that a record of the extensions names, right-up-back without one. Raises ValueError for other frames.

    A record is its type, its length and its contents; those of unknown types are skipped.
    """
    at = 0
    while at + 8 <= len(extensions):
        kind, length = struct.unpack_from("<II", extensions, at)
        if kind == _FRAME_EXTENSION and at + 12 <= len(extensions):
            frame = int(struct.unpack_from("<I", extensions, at + 8)[0])
            if frame not in (_RDF, _RUB, 0):
                raise ValueError(f"its frame is number {frame}; right-up-back and right-down-front are read")
            return frame or _RUB
        at += 8 + length
    return _RUB


class _Pieces:
    """Bytes one after the other: the body of a file that is not compressed."""

    def __init__(self, data: bytes, begin: int) -> None:
        self._data = data
        self._at = begin

    def take(self, size: int) -> bytes:
        piece = self._data[self._at : self._at + size]
        if len(piece) < size:
            raise ValueError(f"it ends after {len(self._data)} bytes, {size - len(piece)} too early")
        self._at += size
        return piece

    def rest(self) -> bytes:
        """What follows the streams: the extensions."""
        return self._data[self._at :]


class _Frames:
    """The zstd frames of version 4, one a stream, after a table of their sizes. Empty streams have none."""

    def __init__(self, data: bytes, header: _Header) -> None:
        if len(data) < 32:
            raise ValueError(f"it ends after {len(data)} bytes, within its header")
        frames, table = data[15], int(struct.unpack_from("<I", data, 16)[0])
        expected = [width * header.count for width in header.widths() if width * header.count]
        if frames != len(expected):
            raise ValueError(f"it has {frames} streams, where {len(expected)} are needed")
        if not 32 <= table <= len(data) - 16 * frames:
            raise ValueError(f"its table of streams is at byte {table} of {len(data)}")
        sizes = [struct.unpack_from("<QQ", data, table + 16 * index) for index in range(frames)]
        if [size for _, size in sizes] != expected:
            raise ValueError(
                f"its streams have {[size for _, size in sizes]} bytes, where {expected} are needed"
            )
        self._extensions = data[32:table]
        self._compressed = iter([size for size, _ in sizes])
        self._pieces = _Pieces(data, table + 16 * frames)

    def take(self, size: int) -> bytes:
        return unzstd(self._pieces.take(next(self._compressed)), size) if size else b""

    def rest(self) -> bytes:
        """The extensions, which precede the table."""
        return self._extensions


def _fraction_bits(gaussians: Gaussians) -> int:
    """Bits after the point of a position, 0 to 22: as POSITIONS_PER_GAUSSIAN asks, and as 23 bits allow."""
    if not gaussians.count:
        return 12
    longest = gaussians.log_scales.amax(dim=1)
    small = float(longest.kthvalue(1 + (gaussians.count - 1) // 100).values)
    bits = min(22, max(0, math.ceil(math.log2(POSITIONS_PER_GAUSSIAN) - small / math.log(2))))
    reach = float(gaussians.means.abs().max())
    while bits > 0 and reach * 2**bits >= 2**23 - 1:
        bits -= 1
    return bits


def _floats(values: Bytes) -> Tensor:
    return torch.from_numpy(values.astype(np.float32))


def _levels(values: Tensor) -> Bytes:
    levels: Bytes = values.round().clamp(0, 255).to(torch.uint8).numpy()
    return levels


def _positions(values: Bytes, bits: int) -> Tensor:
    words = np.zeros((len(values) * 3, 4), np.uint8)
    words[:, 1:] = values.reshape(-1, 3)  # in the upper three bytes, whose sign is that of the word
    fixed = (words.view("<i4")[:, 0] >> 8).astype(np.float64) / 2.0**bits
    return torch.from_numpy(fixed.astype(np.float32).reshape(-1, 3))


def _packed_harmonics(rest: Tensor, bits: int) -> Bytes:
    """Bytes [N, 3 K] of harmonics [N, K, 3], rounded to the steps of `bits` bits, one of which is zero."""
    step = 2 ** (8 - bits)
    levels = (rest * (128.0 / step)).round() * step + 128
    return _levels(levels.clamp(max=256 - step).flatten(1))


def _packed_rotations(quats: Tensor) -> npt.NDArray[np.uint32]:
    """The index of the largest of xyzw in two bits, then the other three as a sign and nine bits each."""
    turned = quats[:, [1, 2, 3, 0]]
    largest = turned.abs().argmax(dim=1, keepdim=True)
    turned = turned * torch.where(turned.gather(1, largest) < 0, -1.0, 1.0)
    word = largest[:, 0].clone()
    for index in range(4):
        value = turned[:, index]
        size = (value.abs() * (511 * 2**0.5) + 0.5).to(torch.int64).clamp(max=511)
        next_word = (word << 10) | ((value < 0).to(torch.int64) << 9) | size
        word = torch.where(largest[:, 0] == index, word, next_word)
    return word.numpy().astype("<u4")


def _smallest_three(values: Bytes) -> Tensor:
    words = np.ascontiguousarray(values).view("<u4")[:, 0].astype(np.int64)
    largest = torch.from_numpy(words >> 30)
    xyzw = torch.zeros(len(words), 4)
    rest = torch.from_numpy(words)
    for index in (3, 2, 1, 0):
        there = largest != index
        value = (rest & 511).float() * (0.5**0.5 / 511) * torch.where((rest >> 9) & 1 == 1, -1.0, 1.0)
        xyzw[:, index] = torch.where(there, value, 0.0)
        rest = torch.where(there, rest >> 10, rest)
    return _with_largest(xyzw, largest)


def _first_three(values: Bytes) -> Tensor:
    xyz = _floats(values) / 127.5 - 1.0
    xyzw = torch.cat([xyz, torch.zeros(len(xyz), 1)], dim=1)
    return _with_largest(xyzw, torch.full((len(xyz),), 3))


def _with_largest(xyzw: Tensor, missing: Tensor) -> Tensor:
    """Quaternions as wxyz; the component `missing`, which is zero in `xyzw`, is positive and makes the norm 1."""
    value = (1.0 - (xyzw * xyzw).sum(dim=1, keepdim=True)).clamp(min=0).sqrt()
    return xyzw.scatter(1, missing[:, None], value)[:, [3, 0, 1, 2]]
