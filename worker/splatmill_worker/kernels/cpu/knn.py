"""knn on the CPU, through a k-d tree."""

from __future__ import annotations

import torch
from torch import Tensor

from splatmill_worker.kernels import cpu

from ..reference.knn import check_points


def knn(points: Tensor) -> Tensor:
    """Return the mean distance [N] from each of points [N,3] to its three nearest others, as `reference.knn` does."""
    check_points(points)
    distances = torch.empty(points.shape[0])
    if points.shape[0]:
        cpu.engine.knn(points.detach().contiguous(), distances)
    return distances
