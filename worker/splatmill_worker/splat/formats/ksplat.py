"""The `.ksplat` of mkkellogg's GaussianSplats3D: sections of Gaussians in buckets. It is read, not written.

Level 0 stores float32. Levels 1 and 2 store positions as 16-bit steps from the middle of a bucket, scales and
quaternions as float16, and harmonics, up to degree 2, as float16 or as bytes between two bounds. Layout:
https://github.com/mkkellogg/GaussianSplats3D (`src/loaders/SplatBuffer.js`).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.reader_memory import check, check_gaussians
from splatmill_worker.splat.formats.contents import Contents, finite, logits
from splatmill_worker.splat.formats.splat import log_scales
from splatmill_worker.splat.gaussians import SH_C0, Gaussians

HEADER_BYTES = 4096
SECTION_HEADER_BYTES = 1024

_HARMONICS = {0: 0, 1: 9, 2: 24}
_TYPES = ("<f4", "<f2", "u1")  # of the harmonics, by level
_STEPS = 32767  # of half a bucket, where the section does not say


@dataclass(frozen=True)
class _File:
    """level: 0 to 2. low, high: bounds of the harmonics of level 2. sections: those that hold Gaussians."""

    level: int
    low: float
    high: float
    sections: tuple[_Section, ...]


@dataclass(frozen=True)
class _Section:
    """A section; counts and sizes as in its header.

    count: Gaussians. full_buckets, partial_buckets: how many; full ones hold `bucket_capacity` Gaussians.
    step: of a position, in units of the scene. degree: of the harmonics.
    sizes_at, centers_at, rows_at: bytes at which the sizes of the partial buckets, the middles of all buckets and the
        rows begin.
    """

    count: int
    bucket_capacity: int
    bucket_count: int
    full_buckets: int
    partial_buckets: int
    half: int
    step: float
    degree: int
    sizes_at: int
    centers_at: int
    rows_at: int


def read(path: Path) -> Contents:
    """Read a `.ksplat` file. Raises ModelUnreadable, and FileNotFoundError where there is none."""
    size = path.stat().st_size
    try:
        check("reading it", size, size)
        data = path.read_bytes()
        file = _parsed(data[: _head_bytes(data)], size)
        degree = max((section.degree for section in file.sections), default=0)
        check_gaussians(sum(section.count for section in file.sections), degree, size)
        parts = [_gaussians(data, file, section) for section in file.sections]
    except ValueError as error:
        raise ModelUnreadable(f"{path.name} could not be read as a .ksplat file: {error}.") from error
    empty = Gaussians(
        torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0), torch.zeros(0, 1, 3)
    )
    padded = [part.padded(degree) for part in [empty, *parts]]
    return Contents(finite(Gaussians(*(torch.cat(group) for group in zip(*padded, strict=True)))))


def _head_bytes(head: bytes) -> int:
    """Bytes of the headers. Raises ValueError."""
    if len(head) < HEADER_BYTES:
        raise ValueError(f"it has {len(head)} bytes, and its header alone has {HEADER_BYTES}")
    major, minor = head[0], head[1]
    if major != 0 or minor < 1:
        raise ValueError(f"its version is {major}.{minor}, and 0.1 and later are known")
    sections = int(struct.unpack_from("<I", head, 4)[0])
    if sections > 1024:
        raise ValueError(f"it announces {sections} sections, and 1024 are read at most")
    return HEADER_BYTES + sections * SECTION_HEADER_BYTES


def _parsed(head: bytes, size: int) -> _File:
    """The headers of a file of `size` bytes, of which `head` is the beginning. Raises ValueError."""
    begin = _head_bytes(head)
    if len(head) < begin:
        raise ValueError(f"it ends after {len(head)} bytes, within its {begin} bytes of headers")
    level = int(struct.unpack_from("<H", head, 20)[0])
    if level > 2:
        raise ValueError(f"its compression level is {level}, and 0 to 2 are known")
    low, high = struct.unpack_from("<ff", head, 36)
    sections = []
    for at in range(HEADER_BYTES, len(head), SECTION_HEADER_BYTES):
        count, room, capacity, buckets, block, bucket_bytes, _, half, _, full, partial, degree = (
            struct.unpack_from("<IIIIfHHIIIIH", head, at)
        )
        if degree not in _HARMONICS:
            raise ValueError(f"its harmonics are of degree {degree}, and 0 to 2 are known")
        half = half or _STEPS
        centers_at = begin + 4 * partial
        rows_at = centers_at + bucket_bytes * buckets
        end = rows_at + room * _row(level, degree).itemsize
        if count > room or end > size:
            raise ValueError(f"a section of {count} Gaussians ends at byte {end} of {size}")
        if level and (bucket_bytes != 12 or full + partial > buckets):
            raise ValueError(f"a section has {full + partial} of {buckets} buckets of {bucket_bytes} bytes")
        if count:
            step = block / 2.0 / half
            sections.append(
                _Section(
                    count, capacity, buckets, full, partial, half, step, degree, begin, centers_at, rows_at
                )
            )
        begin = end
    return _File(level, low or -1.5, high or 1.5, tuple(sections))


def _row(level: int, degree: int) -> np.dtype[np.void]:
    number, mean = ("<f4", "<f4") if level == 0 else ("<f2", "<u2")
    return np.dtype(
        [
            ("mean", mean, 3),
            ("scale", number, 3),
            ("quat", number, 4),
            ("rgba", "u1", 4),
            ("sh", _TYPES[level], _HARMONICS[degree]),
        ]
    )


def _gaussians(data: bytes, file: _File, section: _Section) -> Gaussians:
    rows = np.frombuffer(data, _row(file.level, section.degree), section.count, section.rows_at)
    means = rows["mean"].astype(np.float32)
    if file.level:
        sizes = np.frombuffer(data, "<u4", section.partial_buckets, section.sizes_at).astype(np.int64)
        centers = np.frombuffer(data, "<f4", 3 * section.bucket_count, section.centers_at).reshape(-1, 3)
        ends = np.concatenate(
            [
                section.bucket_capacity * np.arange(1, section.full_buckets + 1, dtype=np.int64),
                section.bucket_capacity * section.full_buckets + np.cumsum(sizes),
            ]
        )
        bucket = np.searchsorted(ends, np.arange(section.count), side="right")
        if len(bucket) and int(bucket[-1]) >= len(ends):
            raise ValueError(f"its buckets hold fewer than the {section.count} Gaussians of a section")
        means = (means - section.half) * np.float32(section.step) + centers[bucket]
    rgba = torch.from_numpy(rows["rgba"].astype(np.float32) / 255.0)
    sh = [((rgba[:, :3] - 0.5) / SH_C0)[:, None]]
    if section.degree:
        values = rows["sh"].astype(np.float32)
        if file.level == 2:
            values = file.low + values / 255.0 * (file.high - file.low)
        sh.append(_by_coefficient(values))
    return Gaussians(
        means=torch.from_numpy(means.astype(np.float32)),
        log_scales=log_scales(torch.from_numpy(rows["scale"].astype(np.float32))),
        quats=torch.from_numpy(rows["quat"].astype(np.float32)),
        logit_opacities=logits(rgba[:, 3]),
        sh=torch.cat(sh, dim=1),
    )


def _by_coefficient(values: npt.NDArray[np.float32]) -> torch.Tensor:
    """Harmonics [N, K, 3] of rows that hold each degree by channel, then by coefficient."""
    n = len(values)
    degrees = [values[:, :9].reshape(n, 3, 3), values[:, 9:].reshape(n, 3, -1)]
    return torch.from_numpy(np.concatenate(degrees, axis=2)).transpose(1, 2).contiguous()
