"""Depth of the Gaussian at which the transmittance of a pixel falls to one half, or to another value."""

from __future__ import annotations

import torch
from torch import Tensor

from ..records import NEAREST_HORIZON, TILE, Bins, Projected
from .composite import _weights


@torch.no_grad()
def median_depth(
    projected: Projected, bins: Bins, width: int, height: int, *, tilts: Tensor, transmittance: float
) -> Tensor:
    """Return the median depth [H,W]: z where the first splat leaves that transmittance or less, else 0.

    Splats are blended as by `composite`. With d from a splat's mean2d to the pixel centre, z = depth / (1 - tilt . d),
    as on a plane. Where 1 - tilt . d is not above NEAREST_HORIZON, the pixel has no depth.
    """
    columns = -(-width // TILE)
    depth = projected.depths.new_zeros(height, width)
    offsets = bins.offsets.tolist()
    for tile in range(len(offsets) - 1):
        ids = bins.ids[offsets[tile] : offsets[tile + 1]].long()
        if not len(ids):
            continue
        top, left = tile // columns * TILE, tile % columns * TILE
        h, w = min(TILE, height - top), min(TILE, width - left)
        weights = _weights(projected, ids, left, top, w, h, False)
        crossed = 1.0 - weights.cumsum(1) <= transmittance
        first = crossed.to(torch.uint8).argmax(1)
        splat = ids[first]
        y, x = torch.meshgrid(
            torch.arange(top, top + h, device=ids.device, dtype=weights.dtype) + 0.5,
            torch.arange(left, left + w, device=ids.device, dtype=weights.dtype) + 0.5,
            indexing="ij",
        )
        offset = torch.stack([x.reshape(-1), y.reshape(-1)], 1) - projected.means2d[splat]
        nearness = 1.0 - (tilts[splat] * offset).sum(1)
        shown = crossed.any(1) & (nearness > NEAREST_HORIZON)
        z = torch.where(shown, projected.depths[splat] / nearness, 0.0)
        depth[top : top + h, left : left + w] = z.reshape(h, w)
    return depth
