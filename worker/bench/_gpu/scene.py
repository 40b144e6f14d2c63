"""The scene whose passes are timed: Gaussians that fill one view, with a photo of noise."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class View:
    """N Gaussians before a camera at the origin.

    groups: means [N,3], log_scales [N,3], quats [N,4], logit_opacities [N] and sh [N,16,3].
    viewmat: [4,4]. K: [3,3]. photo: uint8 [H,W,3].
    """

    groups: tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
    viewmat: Tensor
    K: Tensor
    photo: Tensor

    @property
    def width(self) -> int:
        return int(self.photo.shape[1])

    @property
    def height(self) -> int:
        return int(self.photo.shape[0])


def cloud(n: int, width: int, height: int, seed: int = 0) -> View:
    """n Gaussians all over the view, most of them about as wide as their spacing, some large."""
    g = torch.Generator().manual_seed(seed)
    depth = 2.0 + 8.0 * torch.rand(n, generator=g)
    focal = 0.9 * width
    place = (torch.rand(n, 2, generator=g) - 0.5) * torch.tensor([width, height]) / focal
    spacing = (width * height / n) ** 0.5
    size = spacing * torch.exp(0.6 * torch.randn(n, 3, generator=g)) * depth[:, None] / focal
    groups = (
        torch.cat([place * depth[:, None], depth[:, None]], 1),
        torch.log(size),
        torch.randn(n, 4, generator=g),
        torch.randn(n, generator=g),
        0.2 * torch.randn(n, 16, 3, generator=g),
    )
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    photo = torch.randint(0, 256, (height, width, 3), generator=g, dtype=torch.uint8)
    return View(groups, torch.eye(4), K, photo)
