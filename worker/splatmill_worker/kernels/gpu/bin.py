"""Tile lists: visible splats are sorted by depth once, written in that order, and their pairs sorted stably by tile."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor

from ..records import ALPHA_MIN, TILE, Bins, Projected
from . import device, record
from .argument import Floats, Int, Ints, Longs, Shorts
from .constant import constant
from .record import CONIC_A, CONIC_B, CONIC_C, EXTENT_X, EXTENT_Y, MEAN_X, MEAN_Y, OPACITY, STRIDE

SIDE = constant(float(TILE))
SPAN = constant(TILE - 1.0)  # from the first pixel centre of a tile to its last
CUT = constant(ALPHA_MIN)
BLOCK = 8
"""Splats per program."""

LANES = 32
"""Candidate tiles that a program tests at a time for each of its splats."""


@dataclass(frozen=True)
class Room:
    """Sizes of the list buffers. Taken from a view's last visit, they let a step run without waiting for the device.

    visible: splats.
    pairs: (tile, Gaussian) pairs.
    """

    visible: int
    pairs: int


@triton.jit
def tile_range(center, extent, tiles):
    """The first tile whose pixel centres 16 i + 0.5 .. 16 i + 15.5 meet center -+ extent, and how many tiles do."""
    limit = tiles * 1.0
    # Bounded while still floats: converting a float that does not fit into an integer is undefined.
    first = tl.minimum(tl.maximum(tl.floor((center - extent - 0.5) / SIDE), 0.0), limit)
    last = tl.minimum(tl.maximum(tl.floor((center + extent - 0.5) / SIDE) + 1.0, 0.0), limit)
    return first.to(tl.int32), tl.maximum(last - first, 0.0).to(tl.int32)


@triton.jit
def form(a, b, c, x, y):
    """The quadratic form d^T C d of the conic (a, b, c) at d = (x, y)."""
    return a * x * x + 2.0 * b * x * y + c * y * y


@triton.jit
def least(a, b, c, mx, my, column, row):
    """The smallest d^T C d over the rectangle of a tile's pixel centres: 0 with the mean inside, else on an edge."""
    x0 = column.to(tl.float32) * SIDE + 0.5 - mx
    y0 = row.to(tl.float32) * SIDE + 0.5 - my
    x1, y1 = x0 + SPAN, y0 + SPAN
    value = form(a, b, c, x0, tl.minimum(tl.maximum(-b * x0 / c, y0), y1))
    value = tl.minimum(value, form(a, b, c, x1, tl.minimum(tl.maximum(-b * x1 / c, y0), y1)))
    value = tl.minimum(value, form(a, b, c, tl.minimum(tl.maximum(-b * y0 / a, x0), x1), y0))
    value = tl.minimum(value, form(a, b, c, tl.minimum(tl.maximum(-b * y1 / a, x0), x1), y1))
    inside = (x0 <= 0.0) & (x1 >= 0.0) & (y0 <= 0.0) & (y1 >= 0.0)
    return tl.where(inside, 0.0, value)


@triton.jit
def pairs_kernel(
    records: Floats, order: Ints, counts: Longs, ends: Longs, keys: Shorts, ids: Ints, visible: Longs, columns: Int,
    rows: Int, room: Int,
    WRITE: tl.constexpr, BLOCK: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """Count the pairs of each splat or, with WRITE, write them: one kernel, so that both find the same pairs.

    Pairs beyond `room` are not written. They are those of the farthest splats; the last of `ends` tells how many pairs
    there are. `keys` are tile numbers, of 32 bits in images with too many tiles for 16.
    """
    slot = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = slot < tl.load(visible)
    splat = tl.load(order + slot, mask=here, other=0)
    source = records + splat.to(tl.int64) * STRIDE
    mx, my = tl.load(source + MEAN_X), tl.load(source + MEAN_Y)
    a, b, c = tl.load(source + CONIC_A), tl.load(source + CONIC_B), tl.load(source + CONIC_C)
    level = 2.0 * tl.log(tl.load(source + OPACITY) / CUT)
    ex = tl.load(source + EXTENT_X, mask=here, other=0.0)
    ey = tl.load(source + EXTENT_Y, mask=here, other=0.0)
    left, across = tile_range(mx, ex, columns)
    top, down = tile_range(my, ey, rows)
    area = tl.where(here, across * down, 0)
    across = tl.maximum(across, 1)
    found = tl.zeros([BLOCK], tl.int64)
    place = found
    if WRITE:
        place = tl.load(ends + slot, mask=here, other=0) - tl.load(counts + slot, mask=here, other=0)
    most = tl.max(area, 0)
    done = 0
    while done < most:
        candidate = done + tl.arange(0, LANES)[None, :]
        column = left[:, None] + candidate % across[:, None]
        row = top[:, None] + candidate // across[:, None]
        value = least(a[:, None], b[:, None], c[:, None], mx[:, None], my[:, None], column, row)
        hit = (candidate < area[:, None]) & (value <= level[:, None])
        one = hit.to(tl.int32)
        if WRITE:
            at = place[:, None] + found[:, None] + (tl.cumsum(one, axis=1) - one)
            fits = hit & (at < room)
            tl.store(keys + at, (row * columns + column).to(keys.dtype.element_ty), mask=fits)
            tl.store(ids + at, splat[:, None] + tl.zeros_like(one), mask=fits)
        found += tl.sum(one, axis=1).to(tl.int64)
        done += LANES
    if not WRITE:
        tl.store(counts + slot, found, mask=here)


@dataclass(frozen=True)
class Lists:
    """The tile lists of one view.

    bins: as `Bins`, except that with a `Room` its ids have `room.pairs` entries, of which offsets[-1] are in use.
    used: int64 [2] on the device, how many visible splats and pairs the view has, whether they fit or not.
    """

    bins: Bins
    used: Tensor


def lists(records: Tensor, width: int, height: int, room: Room | None) -> Lists:
    """Return the tile lists of records [N, 12].

    With `room` nothing waits for the device, and pairs that do not fit are left out, farthest first; the caller reads
    `used` later and gives the view more room on its next visit. Without `room` the exact sizes are read back. Raises
    ValueError for 2^31 pairs or more.
    """
    dev = records.device
    columns, rows = -(-width // TILE), -(-height // TILE)
    tiles = columns * rows
    shown = record.visible(records)
    rank = torch.cumsum(shown, 0)
    visible = rank[-1:] if records.shape[0] else torch.zeros(1, dtype=torch.int64, device=dev)
    most = int(visible) if room is None else min(room.visible, records.shape[0])
    # Compaction without a data-dependent shape: hidden splats and those past the room go to a spare last slot.
    slot = torch.where(shown & (rank <= most), rank - 1, most)
    packed = torch.zeros(most + 1, dtype=torch.int64, device=dev)
    packed.scatter_(0, slot, torch.arange(records.shape[0], device=dev))
    packed = packed[:most]
    held = visible.clamp(max=most)
    depths = torch.where(
        torch.arange(most, device=dev) < held, record.fields(records).depths[packed], torch.inf
    )
    order = packed[torch.sort(depths, stable=True).indices].to(torch.int32)

    counts = torch.zeros(most, dtype=torch.int64, device=dev)
    grid = (triton.cdiv(most, BLOCK),)

    def launch(ends: Tensor | None, keys: Tensor | None, ids: Tensor | None, limit: int) -> None:
        if most:
            pairs_kernel[grid](
                records, order, counts, ends, keys, ids, held, columns, rows, limit,
                WRITE=keys is not None, BLOCK=BLOCK, LANES=LANES, num_warps=4,
            )  # fmt: skip

    launch(None, None, None, 0)
    ends = torch.cumsum(counts, 0)
    total = ends[-1:] if most else torch.zeros(1, dtype=torch.int64, device=dev)
    limit = int(total) if room is None else room.pairs
    if limit >= 2**31:
        raise ValueError(
            f"One view has {limit} tile-Gaussian pairs; the lists hold 2147483647. Use fewer or smaller Gaussians."
        )
    # A 16-bit key halves the passes of the radix sort; tiles + 1 of them fit up to 2600 x 3200 pixels.
    key_type = torch.int16 if tiles < 2**15 - 1 else torch.int32
    keys = torch.full((limit,), tiles, dtype=key_type, device=dev)
    ids = torch.zeros(limit, dtype=torch.int32, device=dev)
    launch(ends, keys, ids, limit)
    keys, by_tile = torch.sort(keys, stable=True)
    offsets = torch.searchsorted(keys, torch.arange(tiles + 1, device=dev, dtype=key_type))
    return Lists(Bins(offsets, ids[by_tile]), torch.cat([visible, total]))


def bin(projected: Projected, width: int, height: int) -> Bins:
    """List for every tile the Gaussians that reach it, front to back, as `reference.bin` defines it.

    Waits for the device, to read the number of pairs.
    """
    device.require(projected.means2d)
    with torch.no_grad():
        return lists(record.pack(projected), width, height, None).bins
