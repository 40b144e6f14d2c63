"""Normalised cross-correlation of patches with another image, at many depths of each patch."""

from __future__ import annotations

import torch
from torch import Tensor

LEAST_DEPTH = 1e-6
"""Depth in the other camera, in units of the patch's, up to which a point counts as behind it."""


@torch.no_grad()
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
    """Return the correlation [N,D] of each patch with what the image shows at each depth; -1 where it shows nothing."""
    height, width = image.shape
    points = (rays @ turn.T)[:, None] + (inverse_depths[:, None] * shift)[:, None]  # [N,D,M,3]
    pixels = points[..., :2] / points[..., 2:].clamp_min(LEAST_DEPTH)
    middle = rays.shape[1] // 2
    x, y = pixels[:, :, middle].unbind(-1)
    shown = (points[:, :, middle, 2] > LEAST_DEPTH) & (x > margin) & (x < width - margin)
    shown &= (y > margin) & (y < height - margin)
    samples = _bilinear(image, pixels)
    samples = samples - samples.mean(-1, keepdim=True)
    variance = samples.square().mean(-1).clamp_min(least_variance)
    scores = (samples * patches[:, None]).sum(-1) / (variance * rays.shape[1]).sqrt()
    return torch.where(shown, scores, -1.0)


def _bilinear(image: Tensor, pixels: Tensor) -> Tensor:
    """The image at pixels [...,2], whose first centre is (0.5, 0.5), and its border beyond. NaN counts as 0."""
    height, width = image.shape
    x = (pixels[..., 0] - 0.5).nan_to_num(0.0).clamp(0, width - 1)
    y = (pixels[..., 1] - 0.5).nan_to_num(0.0).clamp(0, height - 1)
    left, top = x.floor().clamp_max(width - 2), y.floor().clamp_max(height - 2)
    u, v = x - left, y - top
    at = top.long() * width + left.long()
    flat = image.reshape(-1)
    upper = flat[at] + u * (flat[at + 1] - flat[at])
    lower = flat[at + width] + u * (flat[at + width + 1] - flat[at + width])
    return upper + v * (lower - upper)
