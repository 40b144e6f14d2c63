"""Orders points along a space-filling curve (Morton 1966): neighbours in the order are neighbours in space."""

from __future__ import annotations

import torch
from torch import Tensor

BITS = 20
"""Per axis. The core of a scene is resolved although a far shell widens the box by a factor of a thousand."""

_SPREAD = ((32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3),
           (2, 0x1249249249249249))  # fmt: skip


def morton_order(points: Tensor, *, cubic: bool = False) -> Tensor:
    """Indices, int64 [N], that sort finite `points` [N, 3] along the curve through their bounding box.

    cubic: through the cube that holds the box, so that runs of points are as wide as they are long in a long scene too.
    """
    if not len(points):
        return torch.zeros(0, dtype=torch.int64)
    low, high = torch.aminmax(points, dim=0)
    side = (high - low).clamp(min=1e-30)
    cells = ((points - low) / (side.max() if cubic else side) * ((1 << BITS) - 1)).to(torch.int64)
    for shift, mask in _SPREAD:
        cells = (cells | (cells << shift)) & mask
    x, y, z = cells.unbind(dim=1)
    return torch.argsort(x | (y << 1) | (z << 2))
