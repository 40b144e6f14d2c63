"""The CPU engine's layout of a scene: blocks [blocks, 59, 16] of sixteen Gaussians, one lane each."""

from __future__ import annotations

from itertools import accumulate

import torch
from torch import Tensor

from splatmill_worker.kernels.records import GROUPS, PARAMETERS

from . import engine

LANES = 16
"""Gaussians in a block."""

FIRST = {name: end - GROUPS[name] for name, end in zip(GROUPS, accumulate(GROUPS.values()), strict=True)}
"""First row of each parameter group in a block; the columns of the plain [N, 59] form have the same order."""


def empty(count: int) -> Tensor:
    """Return zeroed blocks for `count` Gaussians."""
    blocks = torch.zeros(-(-count // LANES), PARAMETERS, LANES)
    # torch has touched the memory: the system may still put huge pages in its place in the course of a long run.
    engine.advise_huge_pages(blocks)
    return blocks


def pack(groups: dict[str, Tensor], count: int, threads: int, order: Tensor | None = None) -> Tensor:
    """Return blocks that hold the groups [count, ...]; coefficients of sh that are not given are 0.

    order: int64 [count], the row of the groups that each Gaussian of the blocks is; None: the same.

    Unused lanes are all 0: with a quaternion of 0 a Gaussian is never visible, and Adam leaves it where it is.
    """
    blocks = empty(count)
    flat = [g.detach().unsqueeze(1).flatten(1).contiguous() for g in groups.values()]
    engine.pack(flat, [FIRST[name] for name in groups], blocks, count, order, threads)
    return blocks


def unpack(
    blocks: Tensor, shapes: dict[str, torch.Size], count: int, threads: int, order: Tensor | None = None
) -> dict[str, Tensor]:
    """Return the groups in blocks as plain tensors of the given shapes [count, ...]; order as it was packed in."""
    groups = {name: torch.empty(shape) for name, shape in shapes.items()}
    flat = [g.unsqueeze(1).flatten(1) for g in groups.values()]  # views of `groups`
    engine.unpack(flat, [FIRST[name] for name in groups], blocks, count, order, threads)
    return groups


def pack_rows(rows: Tensor, threads: int, order: Tensor | None = None) -> Tensor:
    """Return blocks that hold plain rows [N, 59], such as moments, in the order that `pack` describes."""
    blocks = empty(len(rows))
    engine.pack([rows.detach().contiguous()], [0], blocks, len(rows), order, threads)
    return blocks


def unpack_rows(blocks: Tensor, count: int, threads: int, order: Tensor | None = None) -> Tensor:
    """Return the plain rows [count, 59] of blocks; order as they were packed in."""
    rows = torch.empty(count, PARAMETERS)
    engine.unpack([rows], [0], blocks, count, order, threads)
    return rows
