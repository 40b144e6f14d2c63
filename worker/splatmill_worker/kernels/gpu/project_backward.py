"""The gradient of projection: from a view's gradient records to the five parameter groups and the camera."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from .device_functions.harmonics import at, basis, shade, slope
from .device_functions.projection import (
    BLUR,
    LN2,
    covariance,
    factor,
    load3,
    load4,
    load_camera,
    normalised,
    rotation,
    slope_row,
    through,
)
from .launch.argument import Floats, Int
from .launch.tuning import PROJECT_BACKWARD, autotune
from .record import (
    BLUE,
    DEPTH,
    EXTENT_X,
    GRADIENT_STRIDE,
    GREEN,
    MEAN_X,
    MEAN_Y,
    RED,
    STRIDE,
    SUM_Q,
    SUM_QUU,
    SUM_QUV,
    SUM_QVV,
)


@triton.jit
def store3(pointer, i, here, stride, x, y, z, PLANAR: tl.constexpr):
    """Write three channels of a block."""
    tl.store(at(pointer, i, 0, stride, 3, PLANAR), x, mask=here)
    tl.store(at(pointer, i, 1, stride, 3, PLANAR), y, mask=here)
    tl.store(at(pointer, i, 2, stride, 3, PLANAR), z, mask=here)


@triton.jit
def add_row(pointer, x, y, z, t):
    """Add the block's sums to one row of the gradient of the viewmat."""
    tl.atomic_add(pointer, tl.sum(x, axis=0))
    tl.atomic_add(pointer + 1, tl.sum(y, axis=0))
    tl.atomic_add(pointer + 2, tl.sum(z, axis=0))
    tl.atomic_add(pointer + 3, tl.sum(t, axis=0))


@triton.jit
def back_through_factor(u, v, ux, uy, vy, quu, quv, qvv):
    """For one column (p, q) of M with F (p, q) = (u, v): dL/dp, dL/dq, and dL/d log-scale of that column."""
    to_u = 2.0 * (quu * u + quv * v)
    to_v = 2.0 * (quv * u + qvv * v)
    return ux * to_u, uy * to_u + vy * to_v, u * to_u + v * to_v


@autotune(PROJECT_BACKWARD, key=["USED", "PLANAR"])
@triton.jit
def color_backward_kernel(
    means: Floats, sh: Floats, viewmat: Floats, K: Floats, records: Floats, gradient: Floats, d_means: Floats,
    d_sh: Floats, count: Int, stride: Int,
    COEFFICIENTS: tl.constexpr, USED: tl.constexpr, PLANAR: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """From the colour to the SH coefficients and, through the direction, to the mean.

    d_means then holds that part alone; `shape_backward_kernel` adds the rest.
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = i < count
    visible = here & (tl.load(records + i.to(tl.int64) * STRIDE + EXTENT_X, mask=here, other=0.0) > 0.0)
    w00, w01, w02, w10, w11, w12, w20, w21, w22, t0, t1, t2, _, _, _, _ = load_camera(viewmat, K)
    m0, m1, m2 = load3(means, i, visible, stride, PLANAR)
    grow = gradient + i.to(tl.int64) * GRADIENT_STRIDE
    g_red = tl.load(grow + RED, mask=visible, other=0.0)
    g_green = tl.load(grow + GREEN, mask=visible, other=0.0)
    g_blue = tl.load(grow + BLUE, mask=visible, other=0.0)
    d0 = m0 + w00 * t0 + w10 * t1 + w20 * t2
    d1 = m1 + w01 * t0 + w11 * t1 + w21 * t2
    d2 = m2 + w02 * t0 + w12 * t1 + w22 * t2
    length = tl.sqrt_rn(d0 * d0 + d1 * d1 + d2 * d2)
    # A row that is not seen may sit on the camera centre; it gets direction 0 and no gradient.
    length = tl.where(length > 0.0, length, 1.0)
    d0, d1, d2 = d0 / length, d1 / length, d2 / length
    red, green, blue = shade(sh, i, visible, stride, d0, d1, d2, COEFFICIENTS, USED, PLANAR)
    g_red = tl.where(red >= 0.0, g_red, 0.0)
    g_green = tl.where(green >= 0.0, g_green, 0.0)
    g_blue = tl.where(blue >= 0.0, g_blue, 0.0)
    n0 = tl.zeros_like(d0)
    n1, n2 = n0, n0
    for k in tl.static_range(USED):
        value = basis(d0, d1, d2, k)
        tl.store(at(d_sh, i, 3 * k, stride, 3 * COEFFICIENTS, PLANAR), value * g_red, mask=here)
        tl.store(at(d_sh, i, 3 * k + 1, stride, 3 * COEFFICIENTS, PLANAR), value * g_green, mask=here)
        tl.store(at(d_sh, i, 3 * k + 2, stride, 3 * COEFFICIENTS, PLANAR), value * g_blue, mask=here)
    for k in tl.static_range(1, USED):
        r = tl.load(at(sh, i, 3 * k, stride, 3 * COEFFICIENTS, PLANAR), mask=visible, other=0.0)
        g = tl.load(at(sh, i, 3 * k + 1, stride, 3 * COEFFICIENTS, PLANAR), mask=visible, other=0.0)
        b = tl.load(at(sh, i, 3 * k + 2, stride, 3 * COEFFICIENTS, PLANAR), mask=visible, other=0.0)
        pulled = r * g_red + g * g_green + b * g_blue
        sx, sy, sz = slope(d0, d1, d2, k)
        n0 += pulled * sx
        n1 += pulled * sy
        n2 += pulled * sz
    along = n0 * d0 + n1 * d1 + n2 * d2
    store3(
        d_means, i, here, stride,
        (n0 - d0 * along) / length, (n1 - d1 * along) / length, (n2 - d2 * along) / length, PLANAR,
    )  # fmt: skip


@autotune(PROJECT_BACKWARD, key=["PLANAR", "VIEWMAT"], reset=["d_viewmat"])
@triton.jit
def shape_backward_kernel(
    means: Floats, log_scales: Floats, quats: Floats, logit_opacities: Floats, viewmat: Floats, K: Floats,
    records: Floats, gradient: Floats, d_means: Floats, d_log_scales: Floats, d_quats: Floats, d_logits: Floats,
    d_viewmat: Floats, count: Int, stride: Int, width: Int, height: Int,
    PLANAR: tl.constexpr, ANTIALIAS: tl.constexpr, VIEWMAT: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """From the 2-D mean, factor, opacity and depth to mean, scales, quaternion, logit and, with VIEWMAT, the camera."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = i < count
    row = records + i.to(tl.int64) * STRIDE
    visible = here & (tl.load(row + EXTENT_X, mask=here, other=0.0) > 0.0)
    w00, w01, w02, w10, w11, w12, w20, w21, w22, t0, t1, t2, fx, fy, cx, cy = load_camera(viewmat, K)
    # Culled Gaussians are not read: what they hold (NaN, say) cannot come back as a gradient.
    m0, m1, m2 = load3(means, i, visible, stride, PLANAR)
    l0, l1, l2 = load3(log_scales, i, visible, stride, PLANAR)
    qw, qx, qy, qz = load4(quats, i, visible, stride, PLANAR)
    logit = tl.load(logit_opacities + i, mask=visible, other=0.0)
    grow = gradient + i.to(tl.int64) * GRADIENT_STRIDE
    g_mx = tl.load(grow + MEAN_X, mask=visible, other=0.0)
    g_my = tl.load(grow + MEAN_Y, mask=visible, other=0.0)
    quu = 2.0 * LN2 * LN2 * tl.load(grow + SUM_QUU, mask=visible, other=0.0)
    quv = 2.0 * LN2 * LN2 * tl.load(grow + SUM_QUV, mask=visible, other=0.0)
    qvv = 2.0 * LN2 * LN2 * tl.load(grow + SUM_QVV, mask=visible, other=0.0)
    q = tl.load(grow + SUM_Q, mask=visible, other=0.0)
    g_z = tl.load(grow + DEPTH, mask=visible, other=0.0)

    # The forward pass again: cheaper than keeping it. A row that is not seen gets z = 1 and stays finite.
    z = tl.where(visible, w20 * m0 + w21 * m1 + w22 * m2 + t2, 1.0)
    u = (w00 * m0 + w01 * m1 + w02 * m2 + t0) / z
    v = (w10 * m0 + w11 * m1 + w12 * m2 + t1) / z
    low_u, high_u = -(0.15 * width + cx) / fx, (1.15 * width - cx) / fx
    low_v, high_v = -(0.15 * height + cy) / fy, (1.15 * height - cy) / fy
    limited_u = tl.minimum(tl.maximum(u, low_u), high_u)
    limited_v = tl.minimum(tl.maximum(v, low_v), high_v)
    a0, a1, a2 = slope_row(fx, z, limited_u, w00, w01, w02, w20, w21, w22)
    b0, b1, b2 = slope_row(fy, z, limited_v, w10, w11, w12, w20, w21, w22)
    nw, nx, ny, nz, norm = normalised(qw, qx, qy, qz)
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation(nw, nx, ny, nz)
    s0, s1, s2 = tl.exp(l0), tl.exp(l1), tl.exp(l2)
    p0, p1, p2 = through(a0, a1, a2, r00, r01, r02, r10, r11, r12, r20, r21, r22)
    q0, q1, q2 = through(b0, b1, b2, r00, r01, r02, r10, r11, r12, r20, r21, r22)
    p0, p1, p2, q0, q1, q2 = p0 * s0, p1 * s1, p2 * s2, q0 * s0, q1 * s1, q2 * s2  # rows of M
    _, b, c, _, det = covariance(p0, p1, p2, q0, q1, q2)

    # d ln opacity / d logit = 1 - sigmoid, written so that it does not cancel. The antialiasing compensation is a
    # factor of the opacity, without gradient, and does not change the logarithm's.
    against = tl.exp(-logit)
    tl.store(d_logits + i, q * (against / (1.0 + against)), mask=here)

    # Sigma' = M M^T + 0.3 I and dL/dSigma' = F^T Q F with the conic's factor F, so dL/dM = 2 F^T Q (F M). For a needle
    # F M is small where M is large: its first row, ux (p - b/c q), is taken as ux/c (0.3 p + q x minors), in which
    # nothing cancels.
    ux, uy, vy = factor(b, c, det)
    ux_c = ux / c
    n0, n1, n2 = p1 * q2 - p2 * q1, p2 * q0 - p0 * q2, p0 * q1 - p1 * q0
    dp0, dq0, d0 = back_through_factor(
        ux_c * (BLUR * p0 + (q1 * n2 - q2 * n1)), vy * q0, ux, uy, vy, quu, quv, qvv
    )
    dp1, dq1, d1 = back_through_factor(
        ux_c * (BLUR * p1 + (q2 * n0 - q0 * n2)), vy * q1, ux, uy, vy, quu, quv, qvv
    )
    dp2, dq2, d2 = back_through_factor(
        ux_c * (BLUR * p2 + (q0 * n1 - q1 * n0)), vy * q2, ux, uy, vy, quu, quv, qvv
    )
    store3(d_log_scales, i, here, stride, d0, d1, d2, PLANAR)
    dp0, dp1, dp2, dq0, dq1, dq2 = dp0 * s0, dp1 * s1, dp2 * s2, dq0 * s0, dq1 * s1, dq2 * s2

    # The rotation, through the unit quaternion, to the quaternion of any norm.
    e00, e01, e02 = a0 * dp0 + b0 * dq0, a0 * dp1 + b0 * dq1, a0 * dp2 + b0 * dq2
    e10, e11, e12 = a1 * dp0 + b1 * dq0, a1 * dp1 + b1 * dq1, a1 * dp2 + b1 * dq2
    e20, e21, e22 = a2 * dp0 + b2 * dq0, a2 * dp1 + b2 * dq1, a2 * dp2 + b2 * dq2
    hw = 2.0 * (nz * (e10 - e01) + ny * (e02 - e20) + nx * (e21 - e12))
    hx = 2.0 * (ny * (e01 + e10) + nz * (e02 + e20) - 2.0 * nx * (e11 + e22) + nw * (e21 - e12))
    hy = 2.0 * (nx * (e01 + e10) + nz * (e12 + e21) - 2.0 * ny * (e00 + e22) + nw * (e02 - e20))
    hz = 2.0 * (nx * (e02 + e20) + ny * (e12 + e21) - 2.0 * nz * (e00 + e11) + nw * (e10 - e01))
    along = nw * hw + nx * hx + ny * hy + nz * hz
    tl.store(at(d_quats, i, 0, stride, 4, PLANAR), (hw - nw * along) / norm, mask=here)
    tl.store(at(d_quats, i, 1, stride, 4, PLANAR), (hx - nx * along) / norm, mask=here)
    tl.store(at(d_quats, i, 2, stride, 4, PLANAR), (hy - ny * along) / norm, mask=here)
    tl.store(at(d_quats, i, 3, stride, 4, PLANAR), (hz - nz * along) / norm, mask=here)

    # The rows of J W, focal / z (W_row - limited W_2), and the 2-D mean.
    ga0 = r00 * dp0 + r01 * dp1 + r02 * dp2
    ga1 = r10 * dp0 + r11 * dp1 + r12 * dp2
    ga2 = r20 * dp0 + r21 * dp1 + r22 * dp2
    gb0 = r00 * dq0 + r01 * dq1 + r02 * dq2
    gb1 = r10 * dq0 + r11 * dq1 + r12 * dq2
    gb2 = r20 * dq0 + r21 * dq1 + r22 * dq2
    ku, kv = fx / z, fy / z
    free_u = tl.where((u >= low_u) & (u <= high_u), 1.0, 0.0)
    free_v = tl.where((v >= low_v) & (v <= high_v), 1.0, 0.0)
    du = fx * g_mx - free_u * ku * (ga0 * w20 + ga1 * w21 + ga2 * w22)
    dv = fy * g_my - free_v * kv * (gb0 * w20 + gb1 * w21 + gb2 * w22)
    # 1/z scales J W, and with it M, as the three scales together do.
    dz = g_z - (d0 + d1 + d2 + u * du + v * dv) / z
    dx, dy = du / z, dv / z

    # color_backward_kernel left the part through the direction m + W^T t in d_means.
    n0, n1, n2 = load3(d_means, i, visible, stride, PLANAR)
    store3(
        d_means, i, here, stride,
        w00 * dx + w10 * dy + w20 * dz + n0, w01 * dx + w11 * dy + w21 * dz + n1, w02 * dx + w12 * dy + w22 * dz + n2,
        PLANAR,
    )  # fmt: skip

    if VIEWMAT:
        # Through p = W m + t, J W, and the direction m + W^T t.
        add_row(
            d_viewmat,
            dx * m0 + ku * ga0 + t0 * n0, dx * m1 + ku * ga1 + t0 * n1, dx * m2 + ku * ga2 + t0 * n2,
            dx + w00 * n0 + w01 * n1 + w02 * n2,
        )  # fmt: skip
        add_row(
            d_viewmat + 4,
            dy * m0 + kv * gb0 + t1 * n0, dy * m1 + kv * gb1 + t1 * n1, dy * m2 + kv * gb2 + t1 * n2,
            dy + w10 * n0 + w11 * n1 + w12 * n2,
        )  # fmt: skip
        lu, lv = ku * limited_u, kv * limited_v
        add_row(
            d_viewmat + 8,
            dz * m0 - lu * ga0 - lv * gb0 + t2 * n0, dz * m1 - lu * ga1 - lv * gb1 + t2 * n1,
            dz * m2 - lu * ga2 - lv * gb2 + t2 * n2, dz + w20 * n0 + w21 * n1 + w22 * n2,
        )  # fmt: skip


def project_backward(
    groups: tuple[Tensor, ...],
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    records: Tensor,
    gradient: Tensor,
    *,
    degree: int,
    antialias: bool,
    with_viewmat: bool = False,
    planar: int | None = None,
    into: tuple[Tensor, ...] | None = None,
) -> tuple[tuple[Tensor, ...], Tensor | None]:
    """Return the gradients of the five groups, shaped and laid out like them, and of viewmat [4,4] or None.

    records and `planar` as in `project_records`; gradient [N, 16] as `composite_backward` fills it; the gradients of
    the groups are written to `into` where given. Culled rows get exactly zero.
    """
    count = records.shape[0]
    used, room = (degree + 1) ** 2, 16 if planar is not None else groups[4].shape[1]
    if into is None:
        into = tuple(torch.empty_like(x) for x in groups)
        if used < room:
            into[4].zero_()
    means, log_scales, quats, logit_opacities, sh = groups
    d_means, d_log_scales, d_quats, d_logits, d_sh = into
    d_viewmat = torch.zeros(4, 4, device=records.device) if with_viewmat else None
    if count:

        def grid(meta: dict[str, int]) -> tuple[int]:
            return (triton.cdiv(count, meta["BLOCK"]),)

        color_backward_kernel[grid](
            means, sh, viewmat, K, records, gradient, d_means, d_sh, count, planar or 0,
            COEFFICIENTS=room, USED=used, PLANAR=planar is not None,
        )  # fmt: skip
        shape_backward_kernel[grid](
            means, log_scales, quats, logit_opacities, viewmat, K, records, gradient,
            d_means, d_log_scales, d_quats, d_logits, d_viewmat, count, planar or 0, width, height,
            PLANAR=planar is not None, ANTIALIAS=antialias, VIEWMAT=with_viewmat,
        )  # fmt: skip
    return into, d_viewmat
