"""Tile lists: visible splats are sorted by depth once, written in that order, and their pairs sorted stably by tile."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor

from ..records import ALPHA_MIN, MOST_PAIRS, TILE, Bins, Projected, TooManyPairs
from . import device, record
from .launch.argument import Floats, Int, Ints, Longs, Shorts
from .launch.constant import constant
from .record import DEPTH, EXTENT_X, EXTENT_Y, FACTOR_UX, FACTOR_UY, FACTOR_VY, LEVEL, MEAN_X, MEAN_Y, STRIDE

SIDE = constant(float(TILE))
SPAN = constant(TILE - 1.0)  # from the first pixel centre of a tile to its last
LOG2_CUT = constant(math.log2(ALPHA_MIN))
# Added to the cut, so that a list leaves out no pair with a pixel that compositing finds at or above 1/255. u = ux dx +
# uy dy has three roundings of 2^-24 of its terms, in which |dx| and |dy| are at most those of any pixel inside image
# and ellipse; they move u^2 <= log2 255 by twice u times that, here and again where the pixel is blended. What is left
# (the level, the sum of squares, the device's 2^x and log2) is a few 2^-22 of 8.
MARGIN = constant(2e-5)
MARGIN_PER_TERM = constant(2 * 2 * math.sqrt(math.log2(255.0)) * 3 * 2.0**-24)
BLOCK = 8
"""Splats per program."""

LANES = 32
"""Candidate tiles that a program tests at a time for each of its splats."""

SHORT_TILES = 2**15 - 2
"""Tiles whose numbers, with one more for unused room, are sorted as 16-bit keys: half the passes of the radix sort.
Images of up to 8 megapixels have no more."""


@dataclass(frozen=True)
class Room:
    """Sizes of the list buffers. Taken from a view's last visit, they let a step run without waiting for the device.

    visible: splats.
    pairs: (tile, Gaussian) pairs.
    """

    visible: int
    pairs: int


COMPACT_BLOCK = 256
"""Gaussians per program of `compact_kernel`."""


@triton.jit
def compact_kernel(
    records: Floats, rank: Longs, depths: Floats, ids: Ints, count: Int, room: Int, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write depth and number of the first `room` visible splats, in their order; rank [N] counts them up to each."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = i < count
    source = records + i.to(tl.int64) * STRIDE
    slot = tl.load(rank + i, mask=here, other=0) - 1
    shown = here & (tl.load(source + EXTENT_X, mask=here, other=0.0) > 0.0) & (slot < room)
    tl.store(depths + slot, tl.load(source + DEPTH, mask=shown, other=0.0), mask=shown)
    tl.store(ids + slot, i, mask=shown)


@triton.jit
def tile_range(center, extent, tiles):
    """The first tile whose pixel centres 16 i + 0.5 .. 16 i + 15.5 meet center -+ extent, and how many tiles do."""
    limit = tiles * 1.0
    # Bounded while still floats: converting a float that does not fit into an integer is undefined.
    first = tl.minimum(tl.maximum(tl.floor((center - extent - 0.5) / SIDE), 0.0), limit)
    last = tl.minimum(tl.maximum(tl.floor((center + extent - 0.5) / SIDE) + 1.0, 0.0), limit)
    return first.to(tl.int32), tl.maximum(last - first, 0.0).to(tl.int32)


@triton.jit
def least(ux, uy, vy, slope_x, slope_y, mx, my, column, row):
    """The smallest u^2 + v^2 (`record`) over the rectangle of a tile's pixel centres.

    It lies on the edge nearest the mean in x or in y; both are tried.
    """
    x0 = column.to(tl.float32) * SIDE + 0.5 - mx
    y0 = row.to(tl.float32) * SIDE + 0.5 - my
    x1, y1 = x0 + SPAN, y0 + SPAN
    near_x = tl.minimum(tl.maximum(x0, 0.0), x1)
    near_y = tl.minimum(tl.maximum(y0, 0.0), y1)
    dy = tl.minimum(tl.maximum(slope_y * near_x, y0), y1)
    dx = tl.minimum(tl.maximum(slope_x * near_y, x0), x1)
    u1, v1 = ux * near_x + uy * dy, vy * dy
    u2, v2 = ux * dx + uy * near_y, vy * near_y
    return tl.minimum(u1 * u1 + v1 * v1, u2 * u2 + v2 * v2)


@triton.jit
def pairs_kernel(
    records: Floats, order: Ints, counts: Longs, ends: Longs, keys: Shorts, ids: Ints, visible: Longs, columns: Int,
    rows: Int, room: Int,
    WRITE: tl.constexpr, BLOCK: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """Count the pairs of each splat or, with WRITE, write them: one kernel, so that both find the same pairs.

    Pairs beyond `room` are not written. They are those of the farthest splats; the last of `ends` is how many pairs
    there are. `keys` are tile numbers, of 32 bits in images with too many tiles for 16.
    """
    slot = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = slot < tl.load(visible)
    splat = tl.load(order + slot, mask=here, other=0)
    source = records + splat.to(tl.int64) * STRIDE
    mx, my = tl.load(source + MEAN_X), tl.load(source + MEAN_Y)
    ux, uy, vy = tl.load(source + FACTOR_UX), tl.load(source + FACTOR_UY), tl.load(source + FACTOR_VY)
    # The dx where u^2 + v^2 is smallest, per dy, and the dy, per dx.
    slope_x, slope_y = -uy / ux, -ux * uy / (uy * uy + vy * vy)
    ex = tl.load(source + EXTENT_X, mask=here, other=0.0)
    ey = tl.load(source + EXTENT_Y, mask=here, other=0.0)
    most_x = tl.minimum(ex, tl.maximum(mx, columns * SIDE - mx))
    most_y = tl.minimum(ey, tl.maximum(my, rows * SIDE - my))
    margin = MARGIN + MARGIN_PER_TERM * (ux * most_x + tl.abs(uy) * most_y)
    cut = tl.load(source + LEVEL) - LOG2_CUT + margin
    left, across = tile_range(mx, ex, columns)
    top, down = tile_range(my, ey, rows)
    area = tl.where(here, across * down, 0)
    across = tl.maximum(across, 1)
    pairs = tl.zeros([BLOCK], tl.int64)
    place = pairs
    if WRITE:
        place = tl.load(ends + slot, mask=here, other=0) - tl.load(counts + slot, mask=here, other=0)
    most = tl.max(area, 0)
    done = 0
    while done < most:
        candidate = done + tl.arange(0, LANES)[None, :]
        column = left[:, None] + candidate % across[:, None]
        row = top[:, None] + candidate // across[:, None]
        value = least(
            ux[:, None], uy[:, None], vy[:, None], slope_x[:, None], slope_y[:, None], mx[:, None], my[:, None],
            column, row,
        )  # fmt: skip
        hit = (candidate < area[:, None]) & (value <= cut[:, None])
        one = hit.to(tl.int32)
        if WRITE:
            at = place[:, None] + pairs[:, None] + (tl.cumsum(one, axis=1) - one)
            fits = hit & (at < room)
            tl.store(keys + at, (row * columns + column).to(keys.dtype.element_ty), mask=fits)
            tl.store(ids + at, splat[:, None] + tl.zeros_like(one), mask=fits)
        pairs += tl.sum(one, axis=1).to(tl.int64)
        done += LANES
    if not WRITE:
        tl.store(counts + slot, pairs, mask=here)


@dataclass(frozen=True)
class Lists:
    """The tile lists of one view.

    bins: as `Bins`, except that with a `Room` its ids have `room.pairs` entries, of which offsets[-1] are in use.
    shown: bool [N], which Gaussians are visible.
    used: int64 [2] on the device, how many visible splats and pairs the view has, whether they fit or not.
    """

    bins: Bins
    shown: Tensor
    used: Tensor


def lists(records: Tensor, width: int, height: int, room: Room | None) -> Lists:
    """Return the tile lists of records [N, 12].

    With `room` nothing waits for the device, and pairs that do not fit are left out, farthest first; the caller reads
    `used` later and gives the view more room on its next visit. Without `room` the exact sizes are read back. Raises
    TooManyPairs.
    """
    dev = records.device
    columns, rows = -(-width // TILE), -(-height // TILE)
    tiles = columns * rows
    shown = record.visible(records)
    rank = torch.cumsum(shown, 0)
    visible = rank[-1:] if records.shape[0] else torch.zeros(1, dtype=torch.int64, device=dev)
    most = int(visible) if room is None else min(room.visible, records.shape[0])
    # Compaction without a data-dependent shape: the unused room sorts behind every splat.
    held = visible.clamp(max=most)
    depths = torch.full((most,), torch.inf, dtype=torch.float32, device=dev)
    packed = torch.zeros(most, dtype=torch.int32, device=dev)
    if most:
        compact_kernel[(triton.cdiv(records.shape[0], COMPACT_BLOCK),)](
            records, rank, depths, packed, records.shape[0], most, BLOCK=COMPACT_BLOCK
        )
    order = packed[torch.sort(depths, stable=True).indices]

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
    if limit > MOST_PAIRS:
        raise TooManyPairs(
            f"The Gaussians cover {limit} tiles in this view; its lists hold {MOST_PAIRS}. "
            "Use fewer Gaussians or smaller images; a few tiles for each are usual, so most may be far too large."
        )
    key_type = torch.int16 if tiles <= SHORT_TILES else torch.int32
    keys = torch.full((limit,), tiles, dtype=key_type, device=dev)
    ids = torch.zeros(limit, dtype=torch.int32, device=dev)
    launch(ends, keys, ids, limit)
    keys, by_tile = torch.sort(keys, stable=True)
    offsets = torch.searchsorted(keys, torch.arange(tiles + 1, device=dev, dtype=key_type))
    return Lists(Bins(offsets, ids[by_tile]), shown, torch.cat([visible, total]))


def bin(projected: Projected, width: int, height: int) -> Bins:
    """List for every tile the Gaussians that reach it, front to back, as `reference.bin` defines it.

    Waits for the device, to read the number of pairs.
    """
    device.require(projected.means2d)
    with torch.no_grad():
        return lists(record.pack(projected), width, height, None).bins
