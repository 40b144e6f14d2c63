"""Gaussians to the image plane in one kernel: activations, covariance factor, exact extents, SH colour, culling."""

from __future__ import annotations

import math
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..records import ALPHA_MIN, Projected
from . import device, record
from .device_functions.harmonics import shade
from .device_functions.projection import (
    COMPENSATION_MIN,
    LN2,
    covariance,
    factor,
    finite,
    load3,
    load4,
    load_camera,
    normalised,
    rotation,
    slope_row,
    through,
)
from .launch.argument import Float, Floats, Int
from .launch.constant import constant
from .launch.tuning import PROJECT, autotune
from .project_backward import project_backward
from .record import (
    BLUE,
    DEPTH,
    EXTENT_X,
    EXTENT_Y,
    FACTOR_UX,
    FACTOR_UY,
    FACTOR_VY,
    GREEN,
    LEVEL,
    MEAN_X,
    MEAN_Y,
    NOTHING,
    RED,
    STRIDE,
)

CUT = constant(ALPHA_MIN)
LOG2_CUT = constant(math.log2(ALPHA_MIN))


@autotune(PROJECT, key=["USED", "PLANAR"])
@triton.jit
def project_kernel(
    means: Floats, log_scales: Floats, quats: Floats, logit_opacities: Floats, sh: Floats, viewmat: Floats, K: Floats,
    records: Floats, count: Int, stride: Int, width: Int, height: Int, near: Float,
    COEFFICIENTS: tl.constexpr, USED: tl.constexpr, PLANAR: tl.constexpr, ANTIALIAS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the record of each Gaussian: all of it or, where it is culled, zeros and no opacity."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = i < count
    w00, w01, w02, w10, w11, w12, w20, w21, w22, t0, t1, t2, fx, fy, cx, cy = load_camera(viewmat, K)
    m0, m1, m2 = load3(means, i, here, stride, PLANAR)
    l0, l1, l2 = load3(log_scales, i, here, stride, PLANAR)
    qw, qx, qy, qz = load4(quats, i, here, stride, PLANAR)
    logit = tl.load(logit_opacities + i, mask=here, other=0.0)

    z = w20 * m0 + w21 * m1 + w22 * m2 + t2
    u = (w00 * m0 + w01 * m1 + w02 * m2 + t0) / z
    v = (w10 * m0 + w11 * m1 + w12 * m2 + t1) / z
    mx = fx * u + cx
    my = fy * v + cy
    limited_u = tl.minimum(tl.maximum(u, -(0.15 * width + cx) / fx), (1.15 * width - cx) / fx)
    limited_v = tl.minimum(tl.maximum(v, -(0.15 * height + cy) / fy), (1.15 * height - cy) / fy)
    a0, a1, a2 = slope_row(fx, z, limited_u, w00, w01, w02, w20, w21, w22)
    b0, b1, b2 = slope_row(fy, z, limited_v, w10, w11, w12, w20, w21, w22)
    nw, nx, ny, nz, _ = normalised(qw, qx, qy, qz)
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation(nw, nx, ny, nz)
    s0, s1, s2 = tl.exp(l0), tl.exp(l1), tl.exp(l2)
    p0, p1, p2 = through(a0, a1, a2, r00, r01, r02, r10, r11, r12, r20, r21, r22)
    q0, q1, q2 = through(b0, b1, b2, r00, r01, r02, r10, r11, r12, r20, r21, r22)
    a, b, c, sharp, det = covariance(p0 * s0, p1 * s1, p2 * s2, q0 * s0, q1 * s1, q2 * s2)

    opacity = 1.0 / (1.0 + tl.exp(-logit))
    if ANTIALIAS:
        opacity = opacity * tl.sqrt_rn(tl.maximum(sharp / det, COMPENSATION_MIN))
    ux, uy, vy = factor(b, c, det)
    level = tl.log2(tl.maximum(opacity, CUT))
    reach = tl.maximum(
        2.0 * LN2 * (level - LOG2_CUT), 0.0
    )  # squared standard deviations of the 1/255 ellipse
    ex = tl.sqrt_rn(reach * a)
    ey = tl.sqrt_rn(reach * c)

    d0 = m0 + w00 * t0 + w10 * t1 + w20 * t2
    d1 = m1 + w01 * t0 + w11 * t1 + w21 * t2
    d2 = m2 + w02 * t0 + w12 * t1 + w22 * t2
    length = tl.sqrt_rn(d0 * d0 + d1 * d1 + d2 * d2)
    red, green, blue = shade(
        sh, i, here, stride, d0 / length, d1 / length, d2 / length, COEFFICIENTS, USED, PLANAR
    )

    # Every guard is a comparison that NaN fails.
    keep = here & (z > near) & (opacity > CUT) & finite(logit)
    keep = keep & finite(m0) & finite(m1) & finite(m2) & finite(l0) & finite(l1) & finite(l2)
    keep = keep & finite(qw) & finite(qx) & finite(qy) & finite(qz)
    keep = keep & finite(mx) & finite(my) & finite(det) & finite(a) & finite(c)  # b is bounded by a and c
    keep = keep & finite(red) & finite(green) & finite(blue) & finite(z) & finite(ex) & finite(ey)
    keep = keep & (ex > 0.0) & (ey > 0.0)
    keep = keep & (mx + ex > 0.0) & (mx - ex < width) & (my + ey > 0.0) & (my - ey < height)
    out = records + i.to(tl.int64) * STRIDE
    tl.store(out + MEAN_X, tl.where(keep, mx, 0.0), mask=here)
    tl.store(out + MEAN_Y, tl.where(keep, my, 0.0), mask=here)
    tl.store(out + FACTOR_UX, tl.where(keep, ux, 0.0), mask=here)
    tl.store(out + FACTOR_UY, tl.where(keep, uy, 0.0), mask=here)
    tl.store(out + FACTOR_VY, tl.where(keep, vy, 0.0), mask=here)
    tl.store(out + LEVEL, tl.where(keep, level, NOTHING), mask=here)
    tl.store(out + RED, tl.where(keep, tl.maximum(red, 0.0), 0.0), mask=here)
    tl.store(out + GREEN, tl.where(keep, tl.maximum(green, 0.0), 0.0), mask=here)
    tl.store(out + BLUE, tl.where(keep, tl.maximum(blue, 0.0), 0.0), mask=here)
    tl.store(out + DEPTH, tl.where(keep, z, 0.0), mask=here)
    tl.store(out + EXTENT_X, tl.where(keep, ex, 0.0), mask=here)
    tl.store(out + EXTENT_Y, tl.where(keep, ey, 0.0), mask=here)


def project_records(
    groups: tuple[Tensor, ...],
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    degree: int,
    near: float,
    antialias: bool,
    planar: int | None = None,
) -> Tensor:
    """Return the records [N, 12] of the five parameter groups.

    With `planar` the groups lie in planes of that stride, [channels, stride]; without, in rows [N, channels]. Raises
    ValueError for more Gaussians than 32-bit offsets reach.
    """
    count = groups[3].shape[0]
    if count * 64 >= 2**31:
        raise ValueError(
            f"{count} Gaussians were given; offsets into the parameters have 32 bits, enough for 33 million."
        )
    records = torch.empty(count, record.WIDTH, device=viewmat.device, dtype=torch.float32)
    coefficients = 16 if planar is not None else groups[4].shape[1]
    if count:
        project_kernel[lambda meta: (triton.cdiv(count, meta["BLOCK"]),)](
            *groups, viewmat, K, records, count, planar or 0, width, height, near,
            COEFFICIENTS=coefficients, USED=(degree + 1) ** 2, PLANAR=planar is not None, ANTIALIAS=antialias,
        )  # fmt: skip
    return records


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means: Tensor, log_scales: Tensor, quats: Tensor, logit_opacities: Tensor, sh: Tensor,
        viewmat: Tensor, K: Tensor, width: int, height: int, degree: int, near: float, antialias: bool,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        groups = tuple(x.contiguous() for x in (means, log_scales, quats, logit_opacities, sh))
        viewmat, K = viewmat.contiguous(), K.contiguous()
        records = project_records(
            groups, viewmat, K, width, height, degree=degree, near=near, antialias=antialias
        )
        ctx.save_for_backward(*groups, viewmat, K, records)
        ctx.size, ctx.degree, ctx.antialias = (width, height), degree, antialias
        out = record.fields(records)
        ctx.mark_non_differentiable(out.extents)
        ctx.set_materialize_grads(False)
        return tuple(out)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *d_fields: Tensor | None) -> tuple[Tensor | None, ...]:
        *groups, viewmat, K, records = ctx.saved_tensors
        width, height = ctx.size
        gradient = record.gradient_record(d_fields[:5], records)  # all but the extents
        grads, d_viewmat = project_backward(
            tuple(groups), viewmat, K, width, height, records, gradient,
            degree=ctx.degree, antialias=ctx.antialias, with_viewmat=ctx.needs_input_grad[5],
        )  # fmt: skip
        return *grads, d_viewmat, None, None, None, None, None, None


def project(
    means: Tensor,
    log_scales: Tensor,
    quats: Tensor,
    logit_opacities: Tensor,
    sh: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    degree: int,
    near: float = 0.01,
    antialias: bool = False,
) -> Projected:
    """Project Gaussians into one camera, as `reference.project` defines it; float32 tensors on the GPU.

    Gradients reach the five groups and viewmat.
    """
    device.require(means)
    out = _Project.apply(
        means, log_scales, quats, logit_opacities, sh, viewmat, K, width, height, degree, near, antialias
    )
    return Projected(*out)
