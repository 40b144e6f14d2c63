"""Gaussians from points."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.splat.gaussians import SH_C0, Gaussians

ENOUGH_POINTS = 20
"""Number of points of the reconstruction below which Gaussians start at random places instead."""

INITIAL_OPACITY = 0.1
"""Opacity of the first Gaussians (Kerbl et al. 2023)."""


def from_points(points: Tensor, colors: Tensor, *, backend: ops.Backend | None = None) -> Gaussians:
    """One isotropic Gaussian per point [M, 3], as wide as the mean distance to its three nearest neighbours.

    colors: uint8 [M, 3].

    Duplicate points get about the smallest positive width of all, so that none has width zero.
    Raises ValueError for fewer than two points.
    """
    points = points.float()
    width = ops.knn(points, backend=backend)
    positive = width[width > 0]
    # 1e-3 is used where all points coincide.
    floor = float(torch.quantile(positive, 0.001)) if len(positive) else 1e-3
    return isotropic(points, width.clamp_min(floor), colors)


def isotropic(points: Tensor, width: Tensor, colors: Tensor) -> Gaussians:
    """Isotropic Gaussians at `points` [M, 3] with standard deviations `width` [M] and colours uint8 [M, 3].

    Colours do not change with the view: all coefficients above degree 0 are zero, up to degree 3.
    """
    n = points.shape[0]
    quats = torch.zeros(n, 4)
    quats[:, 0] = 1.0
    sh = torch.zeros(n, 16, 3)
    sh[:, 0] = (colors.float() / 255.0 - 0.5) / SH_C0
    return Gaussians(
        points.float(),
        width.float().log()[:, None].expand(n, 3).contiguous(),
        quats,
        torch.full((n,), logit(INITIAL_OPACITY)),
        sh,
    )


def logit(opacity: float) -> float:
    """The logit of an opacity in (0, 1)."""
    return math.log(opacity / (1.0 - opacity))
