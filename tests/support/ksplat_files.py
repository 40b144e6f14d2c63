"""Writes `.ksplat` files of levels 1 and 2 for tests; the format's own writer runs in browsers only."""

import struct

import numpy as np

CAPACITY = 5
"""Gaussians of a full bucket."""

HALF = 32767
"""Steps of half a bucket."""


def ksplat(
    means: np.ndarray,
    scales: np.ndarray,
    quats: np.ndarray,
    rgba: np.ndarray,
    sh: np.ndarray,
    *,
    level: int,
    sections: int = 1,
    block: float = 8.0,
) -> bytes:
    """A file of equal sections, in buckets of CAPACITY whose middles are means of their Gaussians.

    means, scales [n, 3]; quats [n, 4]; rgba uint8 [n, 4]; sh [n, 0, 9 or 24], by degree, channel, coefficient.
    """
    n = len(means)
    degree = {0: 0, 9: 1, 24: 2}[sh.shape[1]]
    head = bytearray(4096)
    struct.pack_into("<BBxxIIIIH", head, 0, 0, 1, sections, sections, n, n, level)
    struct.pack_into("<ff", head, 36, -2.0, 2.0)
    headers, bodies = [], []
    for rows in np.array_split(np.arange(n), sections):
        full, rest = divmod(len(rows), CAPACITY)
        buckets = [rows[i : i + CAPACITY] for i in range(0, len(rows), CAPACITY)]
        header = bytearray(1024)
        struct.pack_into(
            "<IIIIfHHI", header, 0, len(rows), len(rows), CAPACITY, len(buckets), block, 12, 0, HALF
        )
        struct.pack_into("<IIH", header, 32, full, int(rest > 0), degree)
        headers.append(bytes(header))
        body = [struct.pack("<I", rest)] if rest else []
        centers = [means[bucket].mean(axis=0).astype("<f4") for bucket in buckets]
        body += [center.tobytes() for center in centers]
        for bucket, center in zip(buckets, centers, strict=True):
            for i in bucket:
                steps = np.round((means[i] - center) / (block / 2) * HALF) + HALF
                body.append(steps.astype("<u2").tobytes())
                body += [
                    scales[i].astype("<f2").tobytes(),
                    quats[i].astype("<f2").tobytes(),
                    rgba[i].tobytes(),
                ]
                values = sh[i].astype("<f2") if level == 1 else np.round((sh[i] + 2) / 4 * 255).astype("u1")
                body.append(values.tobytes())
        bodies.append(b"".join(body))
    return bytes(head) + b"".join(headers) + b"".join(bodies)
