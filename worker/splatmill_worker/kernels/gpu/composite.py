"""Front-to-back alpha compositing, one program per tile, which leaves the checkpoints for the backward pass."""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..records import TILE, Bins, Projected
from . import device, record
from .blended import PLANES, SEGMENT, Blended
from .composite_backward import blend_backward
from .device_functions.blend import (
    MOST,
    PIXELS,
    STOP,
    advance,
    along_factor,
    checkpoint_of,
    raw_alpha,
    store_checkpoint,
    tile_pixels,
)
from .launch.argument import Floats, Int, Ints, Longs
from .launch.tuning import COMPOSITE, autotune, magnitude
from .record import (
    BLUE,
    DEPTH,
    FACTOR_UX,
    FACTOR_UY,
    FACTOR_VY,
    GREEN,
    LEVEL,
    MEAN_X,
    MEAN_Y,
    NOTHING,
    RED,
    STRIDE,
)


@autotune(COMPOSITE, key=["WITH_DEPTH", "CHECKPOINTS", "magnitude"])
@triton.jit(do_not_specialize=["magnitude"])
def composite_kernel(
    records: Floats, offsets: Longs, ids: Ints, background: Floats, color: Floats, transmittance: Floats,
    depth: Floats, checkpoints: Floats, first_segment: Ints, segment_tile: Ints, width: Int, height: Int, columns: Int,
    magnitude: Int, BACKGROUND: tl.constexpr, WITH_DEPTH: tl.constexpr, CHECKPOINTS: tl.constexpr,
    SEGMENT: tl.constexpr, BATCH: tl.constexpr,
):  # fmt: skip
    tl.static_assert(
        SEGMENT % BATCH == 0, "every segment starts with a batch, or its checkpoint is not written"
    )
    tile = tl.program_id(0)
    column, row = tile_pixels(tile, columns)
    x = column.to(tl.float32) + 0.5
    y = row.to(tl.float32) + 0.5
    inside = (column < width) & (row < height)
    start = tl.load(offsets + tile)
    count = (tl.load(offsets + tile + 1) - start).to(tl.int32)

    through = tl.where(inside, 1.0, 0.0)
    red = tl.zeros([PIXELS], tl.float32)
    green, blue, deep = red, red, red
    done = 0
    most = tl.max(through, 0)
    while (done < count) & (most > STOP):
        if CHECKPOINTS:  # noqa: SIM102  (this one is decided when compiling)
            if done % SEGMENT == 0:
                segment = tl.load(first_segment + tile) + done // SEGMENT
                tl.store(segment_tile + segment, tile)
                place = checkpoint_of(checkpoints, segment)
                store_checkpoint(place, red, green, blue, through, deep, WITH_DEPTH)
        for j in tl.static_range(BATCH):
            listed = done + j < count
            splat = tl.load(ids + start + done + j, mask=listed, other=0)
            source = records + splat.to(tl.int64) * STRIDE
            u, v = along_factor(
                x - tl.load(source + MEAN_X), y - tl.load(source + MEAN_Y),
                tl.load(source + FACTOR_UX), tl.load(source + FACTOR_UY), tl.load(source + FACTOR_VY),
            )  # fmt: skip
            raw = raw_alpha(u, v, tl.load(source + LEVEL, mask=listed, other=NOTHING))
            weight, through, _ = advance(through, tl.minimum(raw, MOST))
            red += weight * tl.load(source + RED)
            green += weight * tl.load(source + GREEN)
            blue += weight * tl.load(source + BLUE)
            if WITH_DEPTH:
                deep += weight * tl.load(source + DEPTH)
        most = tl.max(through, 0)
        done += BATCH

    left_over = tl.abs(through)
    out = row * width + column
    if BACKGROUND:
        red += left_over * tl.load(background)
        green += left_over * tl.load(background + 1)
        blue += left_over * tl.load(background + 2)
    tl.store(color + out * 3, red, mask=inside)
    tl.store(color + out * 3 + 1, green, mask=inside)
    tl.store(color + out * 3 + 2, blue, mask=inside)
    tl.store(transmittance + out, left_over, mask=inside)
    if WITH_DEPTH:
        tl.store(depth + out, deep, mask=inside)


def blend(
    records: Tensor,
    bins: Bins,
    width: int,
    height: int,
    background: Tensor | None,
    *,
    depth: bool,
    checkpoints: bool,
) -> Blended:
    """Composite records [N, 12] into an image, with the depth image and the checkpoints only when asked for.

    The number of checkpoints follows from the room in `bins.ids`, so that nothing waits for the device.
    """
    columns, rows = -(-width // TILE), -(-height // TILE)
    tiles = columns * rows
    like: dict[str, Any] = {"device": records.device, "dtype": torch.float32}
    index: dict[str, Any] = {"device": records.device, "dtype": torch.int32}
    color = torch.empty(height, width, 3, **like)
    transmittance = torch.empty(height, width, **like)
    deep = torch.empty(height, width, **like) if depth else None
    saved = first = owner = None
    if checkpoints:
        lengths = bins.offsets[1:] - bins.offsets[:-1]
        first = torch.zeros(tiles + 1, **index)
        first[1:] = torch.cumsum(torch.div(lengths + (SEGMENT - 1), SEGMENT, rounding_mode="floor"), 0)
        segments = bins.ids.shape[0] // SEGMENT + tiles  # each tile's last segment may be short
        owner = torch.full((segments,), -1, **index)
        saved = torch.empty(segments, PLANES, TILE * TILE, **like)
    composite_kernel[(tiles,)](
        records, bins.offsets, bins.ids, background, color, transmittance, deep, saved, first, owner,
        width, height, columns, magnitude(bins.ids.shape[0]),
        BACKGROUND=background is not None, WITH_DEPTH=depth, CHECKPOINTS=checkpoints, SEGMENT=SEGMENT,
    )  # fmt: skip
    return Blended(color, transmittance, deep, saved, first, owner)


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, depths: Tensor, extents: Tensor,
        background: Tensor | None, bins: Bins, width: int, height: int,
    ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
        records = record.pack(Projected(means2d, conics, opacities, colors, depths, extents))
        training = any(ctx.needs_input_grad[:7])
        made = blend(records, bins, width, height, background, depth=True, checkpoints=training)
        ctx.made, ctx.bins, ctx.size = made, bins, (width, height)
        ctx.save_for_backward(records, background)
        assert made.depth is not None
        return made.color.clone() if training else made.color, 1.0 - made.transmittance, made.depth

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_color: Tensor, d_alpha: Tensor, d_depth: Tensor) -> tuple[Tensor | None, ...]:
        records, background = ctx.saved_tensors
        width, height = ctx.size
        gradient = blend_backward(
            records, ctx.bins, ctx.made, width, height, d_color, d_alpha=d_alpha, d_depth=d_depth
        )
        d_background = None
        if background is not None and ctx.needs_input_grad[6]:
            d_background = (ctx.made.transmittance[..., None] * d_color).sum((0, 1))
        by_field = record.gradient_of_fields(gradient, records)
        return *by_field, None, d_background, None, None, None


def composite(
    projected: Projected, bins: Bins, width: int, height: int, *, background: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Blend the lists into color [H,W,3], alpha [H,W] and depth [H,W], as `reference.composite` defines it."""
    device.require(projected.means2d)
    background = None if background is None else background.to(projected.means2d).contiguous()
    color, alpha, depth = _Composite.apply(*projected, background, bins, width, height)
    return color, alpha, depth
