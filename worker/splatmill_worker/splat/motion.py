"""Rigid motions from twists: the exponential map of SE(3)."""

from __future__ import annotations

import torch
from torch import Tensor


def motion(twist: Tensor) -> Tensor:
    """exp(twist^) [4, 4] of (rho, phi) [6]: the rigid motion that a point p follows with velocity rho + phi x p."""
    matrix = twist.new_zeros(4, 4)
    matrix[:3, :3] = cross_matrix(twist[3:])
    matrix[:3, 3] = twist[:3]
    moved: Tensor = torch.linalg.matrix_exp(matrix)
    return moved


def cross_matrix(vector: Tensor) -> Tensor:
    """The matrix [3, 3] whose product with p is `vector` x p, for a `vector` [3]."""
    x, y, z = vector.unbind()
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
