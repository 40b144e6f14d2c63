"""Mean distance to the three nearest other points on the CPU, through a k-d tree."""

from __future__ import annotations

import torch
from torch import Tensor

from splatmill_worker.kernels import cpu

from ..reference.knn import check_points


def knn(points: Tensor) -> Tensor:
    """Mean distance [N] from each of points [N,3] to its three nearest others; exact, as `reference.knn`."""
    check_points(points)
    distances = torch.empty(points.shape[0])
    if points.shape[0]:
        cpu.engine.knn(points.detach().contiguous(), distances)
    return distances
