"""The `.ksplat` of mkkellogg's GaussianSplats3D: sections of Gaussians in buckets. It is read, not written.

Level 0 stores float32. Levels 1 and 2 store positions as 16-bit steps from the middle of a bucket, scales and
quaternions as float16, and harmonics, up to degree 2, as float16 or as bytes between two bounds. Layout:
https://github.com/mkkellogg/GaussianSplats3D (`src/loaders/SplatBuffer.js`).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.readers.reader_memory import check, check_gaussians
from splatmill_worker.splat.formats.contents import Contents, logits
from splatmill_worker.splat.formats.splat import log_scales
from splatmill_worker.splat.gaussians import SH_C0, Gaussians

HEADER = np.dtype(
    {
        "names": ["major", "minor", "sections", "level", "low", "high"],
        "formats": ["u1", "u1", "<u4", "<u2", "<f4", "<f4"],
        "offsets": [0, 1, 4, 20, 36, 40],
        "itemsize": 4096,
    }
)
"""Level 0 to 2; low and high are the bounds of the harmonics of level 2."""

SECTION = np.dtype(
    {
        "names": [
            "count",
            "room",
            "capacity",
            "buckets",
            "block",
            "bucket_bytes",
            "half",
            "full",
            "partial",
            "degree",
        ],
        "formats": ["<u4", "<u4", "<u4", "<u4", "<f4", "<u2", "<u4", "<u4", "<u4", "<u2"],
        "offsets": [0, 4, 8, 12, 16, 20, 24, 32, 36, 40],
        "itemsize": 1024,
    }
)
"""Of `room` rows, `count` hold Gaussians, in `buckets` with an edge of `block` units, which are 2 `half` steps. `full`
ones hold `capacity` Gaussians; of the `partial` ones, the sizes precede the middles of all buckets and the rows."""

_HARMONICS = {0: 0, 1: 9, 2: 24}
_STEPS = 32767  # of half a bucket, where the section does not say


@dataclass(frozen=True)
class _Section:
    """The fields of a section and of the file, by name; the byte after its partial buckets' sizes; and its rows."""

    fields: dict[str, Any]
    centers_at: int
    rows: npt.NDArray[np.void]


def read(path: Path) -> Contents:
    """Read a `.ksplat` file. Raises ModelUnreadable, and FileNotFoundError where there is none."""
    size = path.stat().st_size
    try:
        check("reading it", size, size)
        data = path.read_bytes()
        sections = _sections(data)
        degree = max((section.fields["degree"] for section in sections), default=0)
        check_gaussians(sum(len(section.rows) for section in sections), degree, size)
        parts = [_gaussians(data, section) for section in sections]
    except ValueError as error:
        raise ModelUnreadable(f"{path.name} could not be read as a .ksplat file: {error}.") from error
    empty = Gaussians(
        torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0), torch.zeros(0, 1, 3)
    )
    padded = [part.padded(degree) for part in [empty, *parts]]
    return Contents.of(Gaussians(*(torch.cat(group) for group in zip(*padded, strict=True))))


def _sections(data: bytes) -> list[_Section]:
    """The sections that hold Gaussians. Raises ValueError."""
    if len(data) < HEADER.itemsize:
        raise ValueError(f"it has {len(data)} bytes, and its header alone has {HEADER.itemsize}")
    file = _fields(data, HEADER, 0)
    if file["major"] != 0 or file["minor"] < 1:
        raise ValueError(f"its version is {file['major']}.{file['minor']}, and 0.1 and later are known")
    if file["sections"] > 1024:
        raise ValueError(f"it announces {file['sections']} sections, and 1024 are read at most")
    if file["level"] > 2:
        raise ValueError(f"its compression level is {file['level']}, and 0 to 2 are known")
    end = HEADER.itemsize + file["sections"] * SECTION.itemsize
    if len(data) < end:
        raise ValueError(f"it ends after {len(data)} bytes, within its {end} bytes of headers")
    sections = []
    for at in range(HEADER.itemsize, end, SECTION.itemsize):
        own = _fields(data, SECTION, at)
        if own["degree"] not in _HARMONICS:
            raise ValueError(f"its harmonics are of degree {own['degree']}, and 0 to 2 are known")
        kind = row(file["level"], own["degree"])
        centers_at = end + 4 * own["partial"]
        rows_at = centers_at + own["bucket_bytes"] * own["buckets"]
        end = rows_at + own["room"] * kind.itemsize
        if own["count"] > own["room"] or end > len(data):
            raise ValueError(f"a section of {own['count']} Gaussians ends at byte {end} of {len(data)}")
        used = own["full"] + own["partial"]
        if file["level"] and (own["bucket_bytes"] != 12 or used > own["buckets"]):
            raise ValueError(
                f"a section has {used} of {own['buckets']} buckets of {own['bucket_bytes']} bytes"
            )
        if own["count"]:
            rows = np.frombuffer(data, kind, own["count"], rows_at)
            sections.append(_Section(file | own, centers_at, rows))
    return sections


def _fields(data: bytes, kind: np.dtype[np.void], at: int) -> dict[str, Any]:
    return dict(zip(kind.names or (), np.frombuffer(data, kind, 1, at)[0].item(), strict=True))


def row(level: int, degree: int) -> np.dtype[np.void]:
    """The type of a Gaussian's row."""
    number, mean = ("<f4", "<f4") if level == 0 else ("<f2", "<u2")
    return np.dtype(
        [
            ("mean", mean, 3),
            ("scale", number, 3),
            ("quat", number, 4),
            ("rgba", "u1", 4),
            ("sh", ("<f4", "<f2", "u1")[level], _HARMONICS[degree]),
        ]
    )


def _gaussians(data: bytes, section: _Section) -> Gaussians:
    own, rows = section.fields, section.rows
    means = rows["mean"].astype(np.float32)
    if own["level"]:
        partial = np.frombuffer(data, "<u4", own["partial"], section.centers_at - 4 * own["partial"])
        centers = np.frombuffer(data, "<f4", 3 * own["buckets"], section.centers_at).reshape(-1, 3)
        full = own["capacity"] * np.arange(1, own["full"] + 1, dtype=np.int64)
        ends = np.append(full, own["capacity"] * own["full"] + np.cumsum(partial.astype(np.int64)))
        bucket = np.searchsorted(ends, np.arange(len(rows)), side="right")
        if int(bucket[-1]) >= len(ends):
            raise ValueError(f"its buckets hold fewer than the {len(rows)} Gaussians of a section")
        half = own["half"] or _STEPS
        means = (means - half) * np.float32(own["block"] / 2.0 / half) + centers[bucket]
    rgba = torch.from_numpy(rows["rgba"].astype(np.float32) / 255.0)
    values = rows["sh"].astype(np.float32)
    if own["level"] == 2:
        low, high = float(own["low"]) or -1.5, float(own["high"]) or 1.5
        values = low + values / 255.0 * (high - low)
    # Rows hold each degree by channel, then by coefficient.
    degrees = [values[:, :9].reshape(len(rows), 3, -1), values[:, 9:].reshape(len(rows), 3, -1)]
    rest = torch.from_numpy(np.concatenate(degrees, axis=2)).transpose(1, 2)
    return Gaussians(
        means=torch.from_numpy(means.astype(np.float32)),
        log_scales=log_scales(torch.from_numpy(rows["scale"].astype(np.float32))),
        quats=torch.from_numpy(rows["quat"].astype(np.float32)),
        logit_opacities=logits(rgba[:, 3]),
        sh=torch.cat([((rgba[:, :3] - 0.5) / SH_C0)[:, None], rest], dim=1),
    )
