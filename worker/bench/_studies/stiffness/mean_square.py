"""The stability limit of Adam's steps where every step sees one photo, drawn at random.

Along one direction, with photo k of curvature h_k in Adam's metric, a step is m' = b m + (1 - b) h_k x, x' = x - m'.
The means of x and m are stable while the mean of h is below 38. Their mean squares also grow by the differences
between the photos: a direction that one photo in many curves gets each time the whole kick of one gradient, h x,
which overshoots where h exceeds 2, however much momentum there is.

The other directions and the changes of the metric are left out, and photos count as drawn independently; training
draws all of them once before any comes again.
"""

from __future__ import annotations

import torch
from torch import Tensor

from splatmill_worker.kernels.records import BETA1


def growth(curvatures: Tensor) -> float:
    """The factor per step on the mean squares of x and m, for curvatures [photos]: above 1 they grow."""
    h = (1.0 - BETA1) * curvatures.double()
    one = torch.ones_like(h)
    steps = torch.stack([torch.stack([1.0 - h, -BETA1 * one], 1), torch.stack([h, BETA1 * one], 1)], 1)
    squares = torch.einsum("kij,klm->iljm", steps, steps).reshape(4, 4) / len(h)
    return float(torch.linalg.eigvals(squares).abs().max())


def ratio(curvatures: Tensor) -> float:
    """How near the steps are to instability: 1 over the factor on all rates at which the mean squares begin to grow.

    0 where the mean curvature is not positive: such a direction has no minimum to be unstable about.
    """
    if not float(curvatures.mean()) > 0:
        return 0.0
    low, high = 0.0, 1e-6 / float(curvatures.abs().max())
    while growth(high * curvatures) < 1.0:
        low, high = high, 2.0 * high
    for _ in range(40):
        between = 0.5 * (low + high)
        low, high = (between, high) if growth(between * curvatures) < 1.0 else (low, between)
    return 1.0 / high
