"""Exact tile lists, sorted front to back."""

from __future__ import annotations

import torch
from torch import Tensor

from ..records import TILE, Bins, Projected


@torch.no_grad()
def bin(projected: Projected, width: int, height: int) -> Bins:
    """List for every 16x16 tile the Gaussians that reach it, front to back, equal depths by index.

    A pair is listed when the smallest value of d^T C d over the rectangle of the tile's pixel centres is at most
    2 ln(255 o), where alpha is 1/255: no pair with a pixel above the cut is missing.
    """
    columns, rows = -(-width // TILE), -(-height // TILE)
    tiles = columns * rows
    visible = torch.nonzero((projected.extents > 0).all(1)).squeeze(1)
    order = visible[torch.argsort(projected.depths[visible], stable=True)]
    center, extent = projected.means2d[order], projected.extents[order]

    # Tiles whose pixel centres 16 i + 0.5 .. 16 i + 15.5 meet the box, bounded by the image while still floats.
    limit = torch.tensor([columns, rows], dtype=center.dtype, device=center.device)
    zero = torch.zeros_like(limit)
    first = torch.floor((center - extent - 0.5) / TILE).clamp(zero, limit).long()
    last = torch.floor((center + extent - 0.5) / TILE).add(1).clamp(zero, limit).long()
    span = (last - first).clamp_min(0)
    counts = span[:, 0] * span[:, 1]
    splat = torch.repeat_interleave(torch.arange(order.numel(), device=order.device), counts)
    ends = torch.cumsum(counts, 0)
    place = torch.arange(splat.numel(), device=order.device) - (ends - counts)[splat]
    column = first[splat, 0] + place % span[splat, 0].clamp_min(1)
    row = first[splat, 1] + place // span[splat, 0].clamp_min(1)

    ids = order[splat]
    level = 2.0 * torch.log(projected.opacities[ids] * 255.0)
    reached = _least(projected.conics[ids], center[splat], column, row) <= level
    tile, ids = (row * columns + column)[reached], ids[reached]
    by_tile = torch.argsort(tile, stable=True)
    offsets = torch.zeros(tiles + 1, dtype=torch.int64, device=order.device)
    offsets[1:] = torch.cumsum(torch.bincount(tile, minlength=tiles), 0)
    return Bins(offsets, ids[by_tile].to(torch.int32))


def _least(conics: Tensor, center: Tensor, column: Tensor, row: Tensor) -> Tensor:
    """Return the smallest d^T C d over the rectangle of a tile's pixel centres: 0 inside, else on an edge."""
    a, b, c = conics.unbind(1)
    x0, y0 = column * TILE + 0.5 - center[:, 0], row * TILE + 0.5 - center[:, 1]
    x1, y1 = x0 + (TILE - 1), y0 + (TILE - 1)

    def form(x: Tensor, y: Tensor) -> Tensor:
        return a * x * x + 2 * b * x * y + c * y * y

    values = []
    for x in (x0, x1):
        values.append(form(x, torch.minimum(torch.maximum(-b * x / c, y0), y1)))
    for y in (y0, y1):
        values.append(form(torch.minimum(torch.maximum(-b * y / a, x0), x1), y))
    least = torch.stack(values).amin(0)
    inside = (x0 <= 0) & (x1 >= 0) & (y0 <= 0) & (y1 >= 0)
    return torch.where(inside, torch.zeros_like(least), least)
