"""bin on the CPU: exact tile lists, sorted by depth with a radix sort, then by tile."""

from __future__ import annotations

import torch

from splatmill_worker.kernels.records import TILE, Bins, Projected

from . import engine


def bin(projected: Projected, width: int, height: int) -> Bins:
    """List for every tile the Gaussians that reach it, front to back, as `reference.bin` defines it."""
    p = Projected(*(field.detach().contiguous() for field in projected))
    frame = engine.Frame()
    pairs = engine.bin(
        frame,
        p.means2d,
        p.conics,
        p.opacities,
        p.depths,
        p.extents,
        width,
        height,
        engine.default_threads(),
    )
    offsets = torch.empty(-(-width // TILE) * -(-height // TILE) + 1, dtype=torch.int64)
    ids = torch.empty(pairs, dtype=torch.int32)
    engine.lists(frame, offsets, ids)
    return Bins(offsets, ids)
