"""Real spherical harmonics to degree 3 and their slopes at unit directions; signs and order as in splat files."""

from __future__ import annotations

import triton
import triton.language as tl

from ..launch.constant import constant

A0 = constant(0.28209479177387814)
A1 = constant(0.4886025119029199)
A2 = constant(1.0925484305920792)
B2 = constant(0.31539156525252005)
C2 = constant(0.5462742152960396)
A3 = constant(0.5900435899266435)
B3 = constant(2.890611442640554)
C3 = constant(0.4570457994644658)
D3 = constant(0.3731763325901154)
E3 = constant(1.445305721320277)


@triton.jit
def at(pointer, i, channel, stride, CHANNELS: tl.constexpr, PLANAR: tl.constexpr):
    """Where channel number `channel` of Gaussian i lies: in planes of `stride` Gaussians, or in rows of CHANNELS."""
    if PLANAR:
        return pointer + channel * stride + i
    return pointer + i * CHANNELS + channel


@triton.jit
def basis(x, y, z, k: tl.constexpr):
    """Harmonic number k (0 to 15, degree by degree) at directions (x, y, z)."""
    if k == 0:
        return tl.zeros_like(x) + A0
    if k == 1:
        return -A1 * y
    if k == 2:
        return A1 * z
    if k == 3:
        return -A1 * x
    if k == 4:
        return A2 * x * y
    if k == 5:
        return -A2 * y * z
    if k == 6:
        return B2 * (2.0 * z * z - x * x - y * y)
    if k == 7:
        return -A2 * x * z
    if k == 8:
        return C2 * (x * x - y * y)
    if k == 9:
        return -A3 * y * (3.0 * x * x - y * y)
    if k == 10:
        return B3 * x * y * z
    if k == 11:
        return -C3 * y * (4.0 * z * z - x * x - y * y)
    if k == 12:
        return D3 * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y)
    if k == 13:
        return -C3 * x * (4.0 * z * z - x * x - y * y)
    if k == 14:
        return E3 * z * (x * x - y * y)
    return -A3 * x * (x * x - 3.0 * y * y)


@triton.jit
def slope(x, y, z, k: tl.constexpr):
    """The derivatives of harmonic number k by x, y and z, taken as independent."""
    none = tl.zeros_like(x)
    if k == 0:
        return none, none, none
    if k == 1:
        return none, none - A1, none
    if k == 2:
        return none, none, none + A1
    if k == 3:
        return none - A1, none, none
    if k == 4:
        return A2 * y, A2 * x, none
    if k == 5:
        return none, -A2 * z, -A2 * y
    if k == 6:
        return -2.0 * B2 * x, -2.0 * B2 * y, 4.0 * B2 * z
    if k == 7:
        return -A2 * z, none, -A2 * x
    if k == 8:
        return 2.0 * C2 * x, -2.0 * C2 * y, none
    if k == 9:
        return -6.0 * A3 * x * y, -3.0 * A3 * (x * x - y * y), none
    if k == 10:
        return B3 * y * z, B3 * x * z, B3 * x * y
    if k == 11:
        return 2.0 * C3 * x * y, -C3 * (4.0 * z * z - x * x - 3.0 * y * y), -8.0 * C3 * y * z
    if k == 12:
        return -6.0 * D3 * x * z, -6.0 * D3 * y * z, 3.0 * D3 * (2.0 * z * z - x * x - y * y)
    if k == 13:
        return -C3 * (4.0 * z * z - 3.0 * x * x - y * y), 2.0 * C3 * x * y, -8.0 * C3 * x * z
    if k == 14:
        return 2.0 * E3 * x * z, -2.0 * E3 * y * z, E3 * (x * x - y * y)
    return -3.0 * A3 * (x * x - y * y), 6.0 * A3 * x * y, none


@triton.jit
def shade(sh, i, here, stride, x, y, z, COEFFICIENTS: tl.constexpr, USED: tl.constexpr, PLANAR: tl.constexpr):
    """Colour before the clamp at 0; not finite where a coefficient that is read is not."""
    red = tl.zeros_like(x) + 0.5
    green = tl.zeros_like(x) + 0.5
    blue = tl.zeros_like(x) + 0.5
    for k in tl.static_range(USED):
        value = basis(x, y, z, k)
        r = tl.load(at(sh, i, 3 * k, stride, 3 * COEFFICIENTS, PLANAR), mask=here, other=0.0)
        g = tl.load(at(sh, i, 3 * k + 1, stride, 3 * COEFFICIENTS, PLANAR), mask=here, other=0.0)
        b = tl.load(at(sh, i, 3 * k + 2, stride, 3 * COEFFICIENTS, PLANAR), mask=here, other=0.0)
        red += value * r
        green += value * g
        blue += value * b
    return red, green, blue
