"""Front-to-back alpha compositing of the tile lists."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ..records import ALPHA_MAX, ALPHA_MIN, NYQUIST, TILE, TRANSMITTANCE_MIN, Bins, Projected, Waves


def composite(
    projected: Projected,
    bins: Bins,
    width: int,
    height: int,
    *,
    background: Tensor | None = None,
    waves: Waves | None = None,
    _soft_cut: bool = False,
) -> tuple[Tensor, Tensor, Tensor]:
    """Blend the lists into color [H,W,3], alpha [H,W] and depth [H,W] = sum of weight times z, not divided by alpha.

    At each pixel centre p, front to back: alpha = min(0.999, o exp(-d^T C d / 2)) with d = p - mean2d. A splat with
    alpha below 1/255 is skipped; one that would bring the transmittance to 1e-4 or below is not blended and ends the
    pixel. The background [3] is weighted by the transmittance left. With waves, the colours vary over the splats.
    `_soft_cut` replaces the jump at 1/255 by a twice differentiable ramp on [1/255, 2/255] and leaves the end out, for
    tests of the gradient's order only.
    """
    columns = -(-width // TILE)
    payload = torch.cat(
        [projected.colors, projected.depths[:, None], torch.ones_like(projected.depths)[:, None]], 1
    )
    strips: list[list[Tensor]] = []
    offsets = bins.offsets.tolist()
    for row in range(-(-height // TILE)):
        strip = []
        for column in range(columns):
            tile = row * columns + column
            ids = bins.ids[offsets[tile] : offsets[tile + 1]].long()
            h, w = min(TILE, height - row * TILE), min(TILE, width - column * TILE)
            weights = _weights(projected, ids, column * TILE, row * TILE, w, h, _soft_cut)
            blended = weights @ payload[ids]
            if waves is not None:
                swing = _swing(projected, waves, ids, weights, column * TILE, row * TILE, w, h)
                blended = torch.cat([blended[:, :3] + swing, blended[:, 3:]], 1)
            strip.append(blended.reshape(h, w, 5))
        strips.append(strip)
    image = torch.cat([torch.cat(strip, 1) for strip in strips], 0)
    color, depth, alpha = image[..., :3], image[..., 3], image[..., 4]
    if background is not None:
        color = color + (1 - alpha)[..., None] * background
    return color, alpha, depth


def _weights(
    projected: Projected, ids: Tensor, left: int, top: int, w: int, h: int, soft_cut: bool
) -> Tensor:
    """Return the blending weights [w*h, len(ids)] of one tile's list at its pixel centres."""
    means2d, conics, opacities = projected.means2d[ids], projected.conics[ids], projected.opacities[ids]
    dx, dy = _offsets(means2d, left, top, w, h)
    a, b, c = conics.unbind(1)
    alphas = opacities * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    alphas = torch.where(alphas <= ALPHA_MAX, alphas, ALPHA_MAX)  # where clamped, no gradient flows
    if soft_cut:
        s = ((alphas - ALPHA_MIN) / ALPHA_MIN).clamp(0.0, 1.0)
        alphas = alphas * (s * s * s * (10 + s * (6 * s - 15)))
    else:
        with torch.no_grad():
            taken = alphas >= ALPHA_MIN
            after = torch.cumprod(torch.where(taken, 1 - alphas, 1.0), 1)
            taken &= (
                after > TRANSMITTANCE_MIN
            )  # it falls along the list, so the first end excludes all that follow
        alphas = torch.where(taken, alphas, 0.0)
    before = torch.cumprod(torch.cat([torch.ones_like(alphas[:, :1]), 1 - alphas[:, :-1]], 1), 1)
    return alphas * before[:, : alphas.shape[1]]


def _offsets(means2d: Tensor, left: int, top: int, w: int, h: int) -> tuple[Tensor, Tensor]:
    """Return x and y of the pixel centres of a tile from the means, [w*h, means] each."""
    y, x = torch.meshgrid(
        torch.arange(top, top + h, device=means2d.device, dtype=means2d.dtype) + 0.5,
        torch.arange(left, left + w, device=means2d.device, dtype=means2d.dtype) + 0.5,
        indexing="ij",
    )
    return x.reshape(-1, 1) - means2d[:, 0], y.reshape(-1, 1) - means2d[:, 1]


def _swing(
    projected: Projected, waves: Waves, ids: Tensor, weights: Tensor, left: int, top: int, w: int, h: int
) -> Tensor:
    """Return what the waves of one tile's list add to its colours, [w*h, 3]."""
    rows = waves.rows[ids].long()
    with torch.no_grad():
        values = waves.values[rows.clamp_min(0)]
        drawn = (rows >= 0) & torch.isfinite(values).all(1) & (values[:, :2].abs() <= NYQUIST).all(1)
    values = waves.values[rows[drawn]]
    dx, dy = _offsets(projected.means2d[ids[drawn]], left, top, w, h)
    cosine = torch.cos(2 * math.pi * (values[:, 0] * dx + values[:, 1] * dy + values[:, 2]))
    return (weights[:, drawn] * cosine) @ values[:, 3:]
