"""Device functions that both compositing passes share: one splat over the 256 pixels of a tile, and checkpoints.

One program walks the list of a tile and holds the state of its pixels in registers, several pixels to a thread. The
loads that all pixels share (ten numbers of a splat, read by all threads at one address) and the sums over pixels are
then paid once for many pixels.
"""

from __future__ import annotations

import triton
import triton.language as tl

from splatmill_worker.kernels.records import ALPHA_MAX, ALPHA_MIN, TILE, TRANSMITTANCE_MIN

from ..blended import PLANES
from ..launch.constant import constant

PIXELS = constant(TILE * TILE)
SIDE = constant(TILE)
CHECKPOINT = constant(PLANES * TILE * TILE)  # floats
LEAST = constant(ALPHA_MIN)
MOST = constant(ALPHA_MAX)
STOP = constant(TRANSMITTANCE_MIN)


@triton.jit
def along_factor(dx, dy, ux, uy, vy):
    """u and v of a record (`record`) at offsets d [256].

    Which product is fused with a sum is written down, here and below: a compiler that chooses may round differently in
    the two passes.
    """
    return tl.fma(dx, ux, dy * uy), dy * vy


@triton.jit
def raw_alpha(u, v, level):
    """Alpha before the clamp at 0.999. The caller skips what is below 1/255, and NaN with it.

    Subtracting the squares from the level one by one saves an instruction, and spills registers with eight splats a
    batch.
    """
    return tl.exp2(level - tl.fma(u, u, v * v))


@triton.jit
def advance(through, alpha):
    """Weight of a splat, the transmittance after it, and whether it is blended, per pixel.

    A finished pixel has a negative transmittance. No product with 1 - alpha exceeds `STOP` again, so nothing more is
    blended, and the absolute value is the transmittance that the background gets.
    """
    weight = alpha * through
    after = through - weight
    shown = alpha >= LEAST
    kept = shown & (after > STOP)
    return (
        tl.where(kept, weight, 0.0),
        tl.where(kept, after, tl.where(shown, -tl.abs(through), through)),
        kept,
    )


@triton.jit
def tile_pixels(tile, columns):
    """Column and row of the 256 pixels of a tile."""
    p = tl.arange(0, PIXELS)
    return (tile % columns) * SIDE + p % SIDE, (tile // columns) * SIDE + p // SIDE


@triton.jit
def checkpoint_of(checkpoints, segment):
    """Where the checkpoint of a segment has its first plane, for each of the 256 pixels."""
    return checkpoints + segment.to(tl.int64) * CHECKPOINT + tl.arange(0, PIXELS)


@triton.jit
def store_checkpoint(place, red, green, blue, through, deep, DEPTH: tl.constexpr):
    """Write the state of a tile's pixels before a segment, one plane per value; the depth plane only with DEPTH."""
    tl.store(place, red)
    tl.store(place + PIXELS, green)
    tl.store(place + 2 * PIXELS, blue)
    tl.store(place + 3 * PIXELS, through)
    if DEPTH:
        tl.store(place + 4 * PIXELS, deep)


@triton.jit
def load_checkpoint(place, DEPTH: tl.constexpr):
    """Red, green, blue, transmittance and depth (0 without DEPTH) as `store_checkpoint` left them."""
    through = tl.load(place + 3 * PIXELS)
    deep = tl.zeros_like(through)
    if DEPTH:
        deep = tl.load(place + 4 * PIXELS)
    return tl.load(place), tl.load(place + PIXELS), tl.load(place + 2 * PIXELS), through, deep
