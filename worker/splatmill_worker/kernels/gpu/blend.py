"""Device functions shared by the compositing passes: a batch of splats against the 256 pixels of a tile.

Arrays are [BATCH, 256], splats along the first axis. In Triton's layout for it a thread holds whole columns, so products and
sums along the list stay in its registers, and every splat's values are loaded once per thread.
"""

from __future__ import annotations

import triton
import triton.language as tl

from .constant import constant

PIXELS = constant(256)
STRIDE = constant(12)  # of record.WIDTH floats
ALPHA_MIN = constant(1.0 / 255.0)
ALPHA_MAX = constant(0.999)
TRANSMITTANCE_MIN = constant(1e-4)
LOG2E = constant(1.4426950408889634)
TF32_BITS = constant(-8192)  # 0xffffe000: sign, exponent and the 10 mantissa bits that a tensor core reads


@triton.jit
def tf32_part(x):
    """The part of x that tf32 holds exactly; x minus it is what a second product has to carry."""
    return (x.to(tl.int32, bitcast=True) & TF32_BITS).to(tl.float32, bitcast=True)


@triton.jit
def exponents(mx, my, a, b, c, x, y, left, top, EXPONENT: tl.constexpr, BATCH: tl.constexpr):
    """d^T C d / 2 [BATCH, 256] at the pixel centres x, y [256]; left, top: corner of the tile.

    "fma" evaluates it as it stands. "dot" expands it in monomials of the pixel relative to the tile's centre, which are
    multiples of 1/4 up to 56.25 and exact in tf32; only the six coefficients are rounded, and their tf32 remainder takes the
    next six of the 16 rows that a tensor core's product needs anyway: one product, about 22 bits.
    """
    if EXPONENT == "dot":
        u = x - (left + 8.0)
        v = y - (top + 8.0)
        ox = (left + 8.0) - mx
        oy = (top + 8.0) - my
        c0 = 0.5 * (a * ox * ox + c * oy * oy) + b * ox * oy
        c1 = a * ox + b * oy
        c2 = b * ox + c * oy
        k = tl.arange(0, 16)
        j = tl.where(k >= 6, k - 6, k)[None, :]
        value = tl.where(j == 0, c0[:, None], tl.where(j == 1, c1[:, None], c2[:, None]))
        value = tl.where(j == 3, 0.5 * a[:, None], value)
        value = tl.where(j == 4, b[:, None], value)
        value = tl.where(j == 5, 0.5 * c[:, None], value)
        high = tf32_part(value)
        coefficients = tl.where(k[None, :] < 6, high, value - high)
        coefficients = tl.where(k[None, :] < 12, coefficients, 0.0)
        sigma = tl.dot(coefficients, monomials(u, v, k % 6), input_precision="tf32")
    else:
        dx = x[None, :] - mx[:, None]
        dy = y[None, :] - my[:, None]
        sigma = 0.5 * (a[:, None] * dx * dx + c[:, None] * dy * dy) + b[:, None] * dx * dy
    return sigma


@triton.jit
def monomials(u, v, which):
    """1, u, v, u^2, uv, v^2 [16, 256] of pixel offsets, row k holding number which[k]."""
    w = which[:, None]
    one = tl.where(w == 0, 1.0, tl.where(w == 1, u[None, :], v[None, :]))
    two = tl.where(w == 3, (u * u)[None, :], tl.where(w == 4, (u * v)[None, :], (v * v)[None, :]))
    return tl.where(w < 3, one, two)


@triton.jit
def alphas(sigma, opacity):
    """min(0.999, o exp(-sigma)) where at least 1/255, else 0; NaN gives 0."""
    alpha = tl.minimum(opacity[:, None] * tl.exp2(-LOG2E * sigma), ALPHA_MAX)
    return tl.where(alpha >= ALPHA_MIN, alpha, 0.0)


@triton.jit
def tile_pixels(tile, columns):
    """Left and top of a tile in pixels, and column and row of its 256 pixels."""
    left = (tile % columns) * 16
    top = (tile // columns) * 16
    p = tl.arange(0, PIXELS)
    return left, top, left + p % 16, top + p // 16
