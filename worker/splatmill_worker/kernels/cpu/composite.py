"""composite on the CPU: sixteen pixels to a vector, and only the 4x4-pixel blocks that an ellipse reaches."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from splatmill_worker.kernels.records import TILE, Bins, Projected, Waves

from . import engine


def composite(
    projected: Projected,
    bins: Bins,
    width: int,
    height: int,
    *,
    background: Tensor | None = None,
    waves: Waves | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Blend the lists into color [H,W,3], alpha [H,W] and depth [H,W], as `reference.composite` defines it."""
    if background is None:
        background = torch.zeros(3)
    image = _Composite.apply(  # type: ignore[no-untyped-call]  # torch leaves it untyped
        *projected, bins.offsets, bins.ids, background, width, height, *(waves or (None, None))
    )
    return image[0], image[1], image[2]


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means2d: Tensor,
        conics: Tensor,
        opacities: Tensor,
        colors: Tensor,
        depths: Tensor,
        extents: Tensor,
        offsets: Tensor,
        ids: Tensor,
        background: Tensor,
        width: int,
        height: int,
        waves: Tensor | None,
        wave_rows: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        rows = [x.detach().contiguous() for x in (means2d, conics, opacities, colors, depths, extents)]
        image = empty_planes(5, width, height)
        frame = engine.Frame()
        engine.composite(
            frame,
            *rows,
            offsets.contiguous(),
            ids.contiguous(),
            width,
            height,
            tuple(background.tolist()),
            image,
            engine.default_threads(),
            None if waves is None else waves.detach().contiguous(),
            None if wave_rows is None else wave_rows.contiguous(),
        )
        ctx.frame, ctx.count, ctx.waves = frame, len(depths), None if waves is None else len(waves)
        ctx.save_for_backward(image)
        return (
            image[:3, :height, :width].permute(1, 2, 0).contiguous(),
            image[3, :height, :width].contiguous(),
            image[4, :height, :width].contiguous(),
        )

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
        (image,) = ctx.saved_tensors
        d_color, d_alpha, d_depth = slopes
        height, width = d_alpha.shape
        gradient = torch.zeros_like(image)
        gradient[:3, :height, :width] = d_color.permute(2, 0, 1)
        gradient[3, :height, :width] = d_alpha
        gradient[4, :height, :width] = d_depth
        n = ctx.count
        d = [torch.zeros(n, *shape) for shape in ((2,), (3,), (), (3,), ())]
        d_waves = None if ctx.waves is None else torch.zeros(ctx.waves, 6)
        engine.composite_backward(ctx.frame, image, gradient, *d, engine.default_threads(), d_waves)
        left = 1.0 - image[3, :height, :width]  # transmittance: the background's weight
        d_background = torch.einsum("hw,hwc->c", left, d_color)
        return (*d, None, None, None, d_background, None, None, d_waves, None)


def empty_planes(planes: int, width: int, height: int) -> Tensor:
    """Return zeroed planes [planes, rows, columns], padded to whole tiles."""
    return torch.zeros(planes, -(-height // TILE) * TILE, -(-width // TILE) * TILE)
