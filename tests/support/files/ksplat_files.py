"""Writes `.ksplat` files of levels 1 and 2 for tests; the format's own writer runs in browsers only."""

import struct

import numpy as np

from splatmill_worker.splat.formats.ksplat import HEADER, SECTION, row

CAPACITY = 5
"""Gaussians of a full bucket."""

HALF = 32767
"""Steps of half a bucket."""


def ksplat(*columns: np.ndarray, level: int, sections: int = 1, block: float = 8.0) -> bytes:
    """A file of equal sections, in buckets of CAPACITY whose middles are means of their Gaussians.

    columns: means and scales [n, 3]; quats [n, 4]; rgba uint8 [n, 4]; sh [n, 0, 9 or 24], by degree, channel,
        coefficient.
    """
    degree = {0: 0, 9: 1, 24: 2}[columns[-1].shape[1]]
    head = np.zeros(1, HEADER)
    head[0] = 0, 1, sections, level, -2.0, 2.0
    counts = struct.pack("<3I", sections, len(columns[0]), len(columns[0]))  # which other readers ask for
    headers, bodies = b"", b""
    for part in np.array_split(np.arange(len(columns[0])), sections):
        means, scales, quats, rgba, sh = (column[part] for column in columns)
        full, rest = divmod(len(part), CAPACITY)
        starts = np.arange(0, len(part), CAPACITY)
        centers = np.add.reduceat(means, starts) / np.diff([*starts, len(part)])[:, None]
        header = np.zeros(1, SECTION)
        header[0] = len(part), len(part), CAPACITY, len(starts), block, 12, HALF, full, rest > 0, degree
        rows = np.zeros(len(part), row(level, degree))
        steps = (means - np.repeat(centers, CAPACITY, axis=0)[: len(part)]) / (block / 2) * HALF
        rows["mean"], rows["scale"], rows["quat"], rows["rgba"] = steps.round() + HALF, scales, quats, rgba
        rows["sh"] = sh if level == 1 else ((sh + 2) / 4 * 255).round()
        headers += header.tobytes()
        bodies += rest.to_bytes(4, "little") * (rest > 0) + centers.astype("<f4").tobytes() + rows.tobytes()
    return head.tobytes()[:8] + counts + head.tobytes()[20:] + headers + bodies
