"""The boxes of the leaves of a scene in levels of detail."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from splatmill_worker.splat.lod.levels import Level
from splatmill_worker.splat.lod.moments import extents

REACH = math.sqrt(2 * math.log(255))
"""Standard deviations at which an opaque Gaussian falls under an opacity of 1/255, up to which a leaf's box goes."""


def leaf_boxes(levels: Sequence[Level]) -> Tensor:
    """The lower and upper corners of the leaves [2, leaves, 3], of all their levels, world units, float64."""
    count = len(levels[0].runs)
    low = torch.full((count, 3), torch.inf, dtype=torch.float64)
    high = -low
    for level in levels:
        leaf = torch.repeat_interleave(torch.arange(count), torch.tensor([run.count for run in level.runs]))
        means, reach = level.gaussians.means.double(), REACH * extents(level.gaussians)
        index = leaf[:, None].expand(-1, 3)
        low.scatter_reduce_(0, index, means - reach, "amin")
        high.scatter_reduce_(0, index, means + reach, "amax")
    empty = low > high
    return torch.stack([low.masked_fill(empty, 0), high.masked_fill(empty, 0)])
