"""Device functions that both projection passes share: a block of Gaussians from the world to the image plane."""

from __future__ import annotations

import math

import triton
import triton.language as tl

from splatmill_worker.kernels import records

from ..launch.constant import LARGEST, constant
from .harmonics import at

BLUR = constant(records.BLUR)
COMPENSATION_MIN = constant(records.COMPENSATION_MIN)
LN2 = constant(math.log(2.0))
HALF_LOG2E = constant(0.5 / math.log(2.0))


@triton.jit
def finite(x):
    """Whether x is neither infinite nor NaN, which fails the comparison."""
    return tl.abs(x) <= LARGEST


@triton.jit
def load3(pointer, i, here, stride, PLANAR: tl.constexpr):
    """Three channels of a block; 0 where there is no Gaussian."""
    return (
        tl.load(at(pointer, i, 0, stride, 3, PLANAR), mask=here, other=0.0),
        tl.load(at(pointer, i, 1, stride, 3, PLANAR), mask=here, other=0.0),
        tl.load(at(pointer, i, 2, stride, 3, PLANAR), mask=here, other=0.0),
    )


@triton.jit
def load4(pointer, i, here, stride, PLANAR: tl.constexpr):
    """Four channels of a block; (1, 0, 0, 0) where there is no Gaussian."""
    return (
        tl.load(at(pointer, i, 0, stride, 4, PLANAR), mask=here, other=1.0),
        tl.load(at(pointer, i, 1, stride, 4, PLANAR), mask=here, other=0.0),
        tl.load(at(pointer, i, 2, stride, 4, PLANAR), mask=here, other=0.0),
        tl.load(at(pointer, i, 3, stride, 4, PLANAR), mask=here, other=0.0),
    )


@triton.jit
def load_camera(viewmat, K):
    """Rows of the rotation, the translation, and fx, fy, cx, cy. Read by each program, so that no launch waits."""
    return (
        tl.load(viewmat), tl.load(viewmat + 1), tl.load(viewmat + 2),
        tl.load(viewmat + 4), tl.load(viewmat + 5), tl.load(viewmat + 6),
        tl.load(viewmat + 8), tl.load(viewmat + 9), tl.load(viewmat + 10),
        tl.load(viewmat + 3), tl.load(viewmat + 7), tl.load(viewmat + 11),
        tl.load(K), tl.load(K + 4), tl.load(K + 2), tl.load(K + 5),
    )  # fmt: skip


@triton.jit
def normalised(w, x, y, z):
    """The unit quaternion, and the norm that (w, x, y, z) had.

    Divided by the largest component first, because the square of 1e-30 is 0 in float32.
    """
    largest = tl.maximum(tl.maximum(tl.abs(w), tl.abs(x)), tl.maximum(tl.abs(y), tl.abs(z)))
    w, x, y, z = w / largest, x / largest, y / largest, z / largest
    norm = tl.sqrt_rn(w * w + x * x + y * y + z * z)
    return w / norm, x / norm, y / norm, z / norm, norm * largest


@triton.jit
def rotation(w, x, y, z):
    """The nine entries of R, row by row, of unit quaternions."""
    return (
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@triton.jit
def slope_row(focal, z, limited, w0, w1, w2, w20, w21, w22):
    """One row of J W: focal / z (W_row - limited W_2), with x/z or y/z limited to 15 % outside the image."""
    k = focal / z
    return k * (w0 - limited * w20), k * (w1 - limited * w21), k * (w2 - limited * w22)


@triton.jit
def through(r0, r1, r2, r00, r01, r02, r10, r11, r12, r20, r21, r22):
    """The row vector (r0, r1, r2) times the matrix R."""
    return r0 * r00 + r1 * r10 + r2 * r20, r0 * r01 + r1 * r11 + r2 * r21, r0 * r02 + r1 * r12 + r2 * r22


@triton.jit
def covariance(p0, p1, p2, q0, q1, q2):
    """a, b, c of M M^T + 0.3 I from the rows of the factor M, det M M^T by Cauchy-Binet, and det (M M^T + 0.3 I).

    In float32, a c - b b loses every digit for needles; the sum of squared minors of the factor loses none.
    """
    tr0 = p0 * p0 + p1 * p1 + p2 * p2
    tr1 = q0 * q0 + q1 * q1 + q2 * q2
    b = p0 * q0 + p1 * q1 + p2 * q2
    minor0 = p1 * q2 - p2 * q1
    minor1 = p2 * q0 - p0 * q2
    minor2 = p0 * q1 - p1 * q0
    sharp = minor0 * minor0 + minor1 * minor1 + minor2 * minor2
    return tr0 + BLUR, b, tr1 + BLUR, sharp, sharp + BLUR * (tr0 + tr1) + BLUR * BLUR


@triton.jit
def factor(b, c, det):
    """ux, uy, vy of a record (`record`) from the covariance and its determinant."""
    ux = tl.sqrt_rn(HALF_LOG2E * (c / det))
    return ux, -(ux * (b / c)), tl.sqrt_rn(HALF_LOG2E / c)
