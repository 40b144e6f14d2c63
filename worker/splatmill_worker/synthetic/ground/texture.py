"""Textures of 8-bit colours with all their mip levels, of which any part is sampled at one level."""

from __future__ import annotations

import math

import numpy as np
import torch

Tensor = torch.Tensor


class Texture:
    """A square RGB texture that repeats in both coordinates; its colours are packed into 32 bits."""

    def __init__(self, image: np.ndarray, width: float) -> None:
        """The texture of `image`, uint8 [S, S, 3], S a power of two, which is `width` metres wide in the world."""
        self.width = width
        self._levels: list[Tensor] = []
        level = image
        while True:
            packed = np.zeros((*level.shape[:2], 4), np.uint8)
            packed[..., :3] = level
            self._levels.append(torch.from_numpy(packed.view(np.int32).reshape(-1)))
            if len(level) == 1:
                break
            halves = level.astype(np.uint16)
            halves = halves[::2] + halves[1::2]
            level = ((halves[:, ::2] + halves[:, 1::2] + 2) // 4).astype(np.uint8)

    def sample(self, u: Tensor, v: Tensor, footprint: float) -> Tensor:
        """Bilinear colours float32 [N, 3], 0 to 255, at `u` and `v` [N], in metres.

        footprint: distance of neighbouring samples, in metres, to which the texels of the level are closest.
        """
        base = math.isqrt(len(self._levels[0]))
        level = round(math.log2(max(footprint * base / self.width, 1.0)))
        level = min(level, len(self._levels) - 1)
        texels, size = self._levels[level], base >> level
        x, y = u * (size / self.width) - 0.5, v * (size / self.width) - 0.5
        left, upper = x.floor(), y.floor()
        x, y = (x - left)[:, None], (y - upper)[:, None]
        # Sizes are powers of two: the last bits of a number are its remainder.
        columns = [column & (size - 1) for column in (left.int(), left.int() + 1)]
        rows = [(row & (size - 1)) * size for row in (upper.int(), upper.int() + 1)]
        corners = [[_unpacked(texels, row + column) for column in columns] for row in rows]
        top, bottom = (torch.lerp(first, second, x) for first, second in corners)
        return torch.lerp(top, bottom, y)[:, :3]


def _unpacked(texels: Tensor, index: Tensor) -> Tensor:
    return texels[index.long()].view(torch.uint8).reshape(-1, 4).float()
