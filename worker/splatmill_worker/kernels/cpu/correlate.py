"""correlate on the CPU: sixteen depths of a patch at a time."""

from __future__ import annotations

import torch
from torch import Tensor

from splatmill_worker.kernels import cpu


def correlate(
    image: Tensor,
    rays: Tensor,
    patches: Tensor,
    inverse_depths: Tensor,
    turn: Tensor,
    shift: Tensor,
    *,
    margin: float,
    least_variance: float,
) -> Tensor:
    """Return the correlation [N,D] of each patch with the image at each depth, as `reference.correlate` does."""
    scores = torch.empty(len(rays), len(inverse_depths))
    tensors = (image, rays, patches, inverse_depths, turn, shift)
    cpu.engine.correlate(*(x.detach().contiguous() for x in tensors), margin, least_variance, scores)
    return scores
