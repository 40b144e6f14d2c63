"""The image of one view as the forward pass leaves it, with the checkpoints that the backward pass starts from."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

SEGMENT = 128
"""Splats between two checkpoints of a tile's list. One program of the backward pass walks one segment: short segments
spread long lists over the GPU, long ones keep the 5 KB of a checkpoint small beside the 128 records that are read."""

PLANES = 5
"""Planes of a checkpoint: red, green, blue, transmittance and depth."""


@dataclass(frozen=True)
class Blended:
    """The image of one view and what its backward pass needs.

    color: [H, W, 3], with the background blended in.
    transmittance: [H, W], what is left behind the last splat. Kept in place of alpha, because 1 - alpha has no
        significant digits where the transmittance is small.
    depth: [H, W], sum of weight times z; None when not asked for.
    checkpoints: [segments, PLANES, 256], the state of a tile's pixels before a segment; None when the view will not be
        differentiated.
    first_segment: int32 [tiles + 1], number of each tile's first segment; None without checkpoints.
    segment_tile: int32 [segments], tile of each segment; -1 where the forward pass stopped before the segment, and past
        the last segment. None without checkpoints.
    """

    color: Tensor
    transmittance: Tensor
    depth: Tensor | None
    checkpoints: Tensor | None
    first_segment: Tensor | None
    segment_tile: Tensor | None
