"""The engine's layout of a scene: blocks of sixteen Gaussians, [blocks, 59, 16], one lane each."""

from __future__ import annotations

import torch
from torch import Tensor

from . import engine

LANES, ROWS = 16, 59
# First row of each parameter group; the columns of the plain [N, 59] form have the same order.
FIRST = {"means": 0, "log_scales": 3, "quats": 6, "logit_opacities": 10, "sh": 11}
WIDTH = {"means": 3, "log_scales": 3, "quats": 4, "logit_opacities": 1, "sh": 48}


def empty(count: int) -> Tensor:
    """Zeroed blocks for `count` Gaussians."""
    blocks = torch.zeros(-(-count // LANES), ROWS, LANES)
    engine.wish_huge_pages(
        blocks
    )  # before the first touch: zeros of this size come untouched from the system
    return blocks


def pack(groups: dict[str, Tensor], count: int, threads: int) -> Tensor:
    """Blocks holding the groups [count, ...]; sh may have fewer than 16 coefficients, the rest are 0.

    Unused lanes stay all zero: a quaternion of 0 is never visible, and rests under Adam.
    """
    blocks = empty(count)
    flat = [g.detach().unsqueeze(1).flatten(1).contiguous() for g in groups.values()]
    engine.pack(flat, [FIRST[name] for name in groups], blocks, count, threads)
    return blocks


def unpack(blocks: Tensor, shapes: dict[str, torch.Size], count: int, threads: int) -> dict[str, Tensor]:
    """Plain tensors of the given shapes [count, ...]."""
    groups = {name: torch.empty(shape) for name, shape in shapes.items()}
    flat = [g.unsqueeze(1).flatten(1) for g in groups.values()]  # views: what is written shows in groups
    engine.unpack(flat, [FIRST[name] for name in groups], blocks, count, threads)
    return groups


def pack_rows(rows: Tensor, threads: int) -> Tensor:
    """Blocks holding plain rows [N, 59] (moments)."""
    blocks = empty(len(rows))
    engine.pack([rows.detach().contiguous()], [0], blocks, len(rows), threads)
    return blocks


def unpack_rows(blocks: Tensor, count: int, threads: int) -> Tensor:
    """Plain rows [count, 59] of blocks."""
    rows = torch.empty(count, ROWS)
    engine.unpack([rows], [0], blocks, count, threads)
    return rows
