"""The record of a projected Gaussian, which the passes gather by index, and the record of its gradient.

A record is one row, because a gather pays by the 32-byte sector: 12 floats are two sectors, and in six separate arrays
they would be six or more.

The shape is held as the triangular factor F = [[ux, uy], [0, vy]] of the conic, C = 2 ln 2 F^T F, and the opacity as
its logarithm: log2 alpha = level - u^2 - v^2 with u = ux dx + uy dy and v = vy dy at the offset (dx, dy) from the mean.
Three float32 numbers of a conic know the short axis of a needle only to the axis ratio squared times the roundoff, the
factor to a few roundoffs (decisions: gpu-records). `kernels/cpu/layout/layout.hpp` has the same record.

The separate ops exchange conics all the same (`Projected`): `fields` and `pack` go from one form to the other, and lose
the digits that a conic loses. The training step stays with records.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ..records import Projected
from .launch.constant import constant

WIDTH = 12
"""Floats of a record."""

GRADIENT_WIDTH = 16
"""Floats of a gradient record: ten sums over pixels, and padding to 64 bytes."""

# Places in a record, as kernels read them.
MEAN_X, MEAN_Y = constant(0), constant(1)  # pixels
FACTOR_UX, FACTOR_UY, FACTOR_VY = constant(2), constant(3), constant(4)  # 1 / pixels
LEVEL = constant(5)  # log2 of the opacity; NOTHING where culled, so that no list can show it
RED, GREEN, BLUE = constant(6), constant(7), constant(8)
DEPTH = constant(9)
EXTENT_X, EXTENT_Y = constant(10), constant(11)  # pixels; 0 where culled
NOTHING = constant(-math.inf)  # log2 of opacity 0

# Places in a gradient record where it differs: the mean, the colour and the depth have the places above. With q = alpha
# dL/dalpha at a pixel, these are the sums of q u^2, q u v, q v^2 and q. They are the gradient to the factor times the
# factor, in which nothing cancels, and that to the logarithm of the opacity.
SUM_QUU, SUM_QUV, SUM_QVV = constant(2), constant(3), constant(4)
SUM_Q = constant(5)
DIFFERENTIABLE = constant(10)  # how many of the first places are in use
STRIDE, GRADIENT_STRIDE = constant(WIDTH), constant(GRADIENT_WIDTH)

LN2 = math.log(2.0)
SHAPE, OPACITY_PLACE, COLOR, DEPTH_PLACE, EXTENT = slice(2, 5), 5, slice(6, 9), 9, slice(10, 12)
"""The same places for the host."""

SMALLEST_DETERMINANT = 6e-8
"""Of a c - b^2 in units of a c, for needles whose determinant three float32 numbers no longer know: the roundoff."""


def visible(records: Tensor) -> Tensor:
    """Return which of records [N, 12] are not culled, as bool [N]."""
    return records[:, EXTENT.start] > 0


def depths(records: Tensor) -> Tensor:
    """Return the camera z [N] of records [N, 12]."""
    return records[:, DEPTH_PLACE]


def fields(records: Tensor) -> Projected:
    """Return records [N, 12] as `Projected`: conics and opacities computed, the other fields views."""
    ux, uy, vy = records[:, SHAPE].unbind(1)
    return Projected(
        means2d=records[:, :2],
        conics=2 * LN2 * torch.stack([ux * ux, ux * uy, uy * uy + vy * vy], 1),
        opacities=torch.exp2(records[:, OPACITY_PLACE]),
        colors=records[:, COLOR],
        depths=depths(records),
        extents=records[:, EXTENT],
    )


def pack(projected: Projected) -> Tensor:
    """Return records [N, 12] float32 of `projected`; the factor has the digits that the conics have."""
    means2d, conics, opacities, colors, depth, extents = (x.detach().double() for x in projected)
    a, b, c = conics.unbind(1)
    det = torch.maximum(a * c - b * b, SMALLEST_DETERMINANT * a * c)
    ux = torch.sqrt(a / (2 * LN2))
    factor = torch.stack([ux, b / (2 * LN2 * ux), torch.sqrt(det / (2 * LN2 * a))], 1)
    shown = (extents > 0).all(1)
    factor = torch.where(shown[:, None], factor, 0.0)
    level = torch.where(shown, torch.log2(opacities), -torch.inf)
    return torch.cat([means2d, factor, level[:, None], colors, depth[:, None], extents], 1).float()


def gradient_of_fields(gradient: Tensor, records: Tensor) -> tuple[Tensor, ...]:
    """Return what gradient records [N, 16] of records [N, 12] say of the first five fields of `Projected`."""
    ux, uy, vy, level = records[:, 2:6].double().unbind(1)
    uu, uv, vv, q = gradient[:, 2:6].double().unbind(1)
    # The offset from u and v: dy = v / vy and dx = (u - uy dy) / ux.
    shear = uy / vy
    xx = (uu - 2 * shear * uv + shear * shear * vv) / (ux * ux)
    xy, yy = (uv - shear * vv) / (ux * vy), vv / (vy * vy)
    shown = visible(records)
    conics = torch.where(shown[:, None], torch.stack([-0.5 * xx, -xy, -0.5 * yy], 1), 0.0)
    opacities = torch.where(shown, q / torch.exp2(level), 0.0)
    return gradient[:, :2], conics.float(), opacities.float(), gradient[:, COLOR], gradient[:, DEPTH_PLACE]


def gradient_record(gradients: tuple[Tensor | None, ...], records: Tensor) -> Tensor:
    """Return the gradient records [N, 16] for gradients to the first five fields of `Projected`; None counts as 0."""
    means2d, conics, opacities, colors, depth = gradients
    gradient = torch.zeros(records.shape[0], GRADIENT_WIDTH, device=records.device)
    if means2d is not None:
        gradient[:, :2] = means2d
    if conics is not None:
        # With D the gradient to the conic as a symmetric matrix, the three sums are those of -2 F D F^T.
        ux, uy, vy = records[:, SHAPE].double().unbind(1)
        da, half_db, dc = (conics.double() * conics.new_tensor([1.0, 0.5, 1.0])).unbind(1)
        first, second = ux * da + uy * half_db, ux * half_db + uy * dc
        sums = torch.stack([first * ux + second * uy, second * vy, vy * vy * dc], 1)
        gradient[:, SHAPE] = (-2 * sums).float()
    if opacities is not None:
        gradient[:, OPACITY_PLACE] = opacities * torch.exp2(records[:, OPACITY_PLACE])
    if colors is not None:
        gradient[:, COLOR] = colors
    if depth is not None:
        gradient[:, DEPTH_PLACE] = depth
    return gradient
