"""median_depth on the CPU: as composite walks its lists, but each pixel only until half of its light is blended."""

from __future__ import annotations

from torch import Tensor

from splatmill_worker.kernels.records import Bins, Projected

from . import engine
from .composite import empty_planes


def median_depth(
    projected: Projected, bins: Bins, width: int, height: int, *, tilts: Tensor, transmittance: float
) -> Tensor:
    """Return the median depth [H,W], as `reference.median_depth` defines it."""
    rows = [x.detach().contiguous() for x in projected]
    image = empty_planes(1, width, height)
    engine.median_depth(
        engine.Frame(),
        *rows,
        tilts.detach().contiguous(),
        transmittance,
        bins.offsets.contiguous(),
        bins.ids.contiguous(),
        width,
        height,
        image,
        engine.default_threads(),
    )
    return image[0, :height, :width].contiguous()
