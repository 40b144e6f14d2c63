"""Device functions shared by the compositing passes: one splat against the 256 pixels of a tile.

A program walks a tile's list with a pixel's state in registers, several pixels to a thread, so that what is
the same for all pixels (ten numbers of a splat, read by all threads at one address) and the sums over pixels
are paid once for many of them.
"""

from __future__ import annotations

import triton
import triton.language as tl

from ..records import ALPHA_MAX, ALPHA_MIN, TILE, TRANSMITTANCE_MIN
from . import record
from .constant import constant

PIXELS = constant(TILE * TILE)
SIDE = constant(TILE)
STRIDE = constant(record.WIDTH)
LEAST = constant(ALPHA_MIN)
MOST = constant(ALPHA_MAX)
STOP = constant(TRANSMITTANCE_MIN)
LOG2E = constant(1.4426950408889634)


@triton.jit
def alpha_of(dx, dy, a, b, c, opacity):
    """min(0.999, o exp(-d^T C d / 2)) at offsets d [256]; where it is below 1/255 the caller skips it, and
    NaN is below.
    """
    power = dx * ((-0.5 * LOG2E * a) * dx + (-LOG2E * b) * dy) + ((-0.5 * LOG2E * c) * dy) * dy
    return tl.minimum(opacity * tl.exp2(power), MOST)


@triton.jit
def advance(through, alpha):
    """Weight of a splat, the transmittance after it, and whether it is blended.

    A pixel that is done has a negative transmittance: no product with 1 - alpha passes the stop again, and
    its size is what is left for the background.
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
    """Column and row of a tile's 256 pixels."""
    p = tl.arange(0, PIXELS)
    return (tile % columns) * SIDE + p % SIDE, (tile // columns) * SIDE + p // SIDE
