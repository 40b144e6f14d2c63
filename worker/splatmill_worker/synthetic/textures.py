"""Random textures with structure at every scale, and their mip-mapped look-up."""

from __future__ import annotations

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFilter
from torch.nn import functional

_PALETTE = np.array(
    [
        (231, 111, 81), (244, 162, 97), (233, 196, 106), (42, 157, 143), (38, 70, 83),
        (240, 236, 226), (120, 86, 140), (200, 70, 90), (90, 150, 200), (60, 60, 64),
    ]
)  # fmt: skip


_ROWS = 32
"""Rows of a texture that are painted at a time."""


class MipMap:
    """A square RGB texture of period 1 in both coordinates, with all its mip levels."""

    def __init__(self, image: np.ndarray) -> None:
        """The texture of `image`, uint8 [S, S, 3], with S a power of two."""
        level = torch.from_numpy(image.astype(np.float32) / 255)
        levels, starts, sizes, start = [], [], [], 0
        while True:
            size = len(level)
            levels.append(level.reshape(-1, 3))
            starts.append(start)
            sizes.append(size)
            start += size * size
            if size == 1:
                break
            left, right = level[:, ::2], level[:, 1::2]
            level = ((left[::2] + right[::2]) + (left[1::2] + right[1::2])) / 4
        self._texels = torch.cat(levels)
        self._starts = torch.tensor(starts)
        self._sizes = torch.tensor(sizes)

    def sample(self, uv: torch.Tensor, footprint: torch.Tensor) -> torch.Tensor:
        """Bilinear colours [N, 3], 0 to 1, at `uv` [N, 2], from the level whose texels are as wide as `footprint` [N].

        The footprint is in texture widths.
        """
        level = torch.log2((footprint * self._sizes[0]).clamp(min=1)).round().long()
        level = level.clamp(max=len(self._sizes) - 1)
        size, start = self._sizes[level], self._starts[level]
        x = uv[:, 0] * size - 0.5
        y = uv[:, 1] * size - 0.5
        x0, y0 = torch.floor(x), torch.floor(y)
        right, lower = x - x0, y - y0
        # Sizes are powers of two: the last bits of a number are its remainder.
        last = size - 1
        columns = x0.long() & last, (x0.long() + 1) & last
        rows = (start + (row & last) * size for row in (y0.long(), y0.long() + 1))
        texels = torch.stack([row + column for row in rows for column in columns], 1)
        left, upper = 1 - right, 1 - lower
        shares = torch.stack([upper * left, upper * right, lower * left, lower * right], 1)
        return functional.embedding_bag(texels, self._texels, mode="sum", per_sample_weights=shares)


def painted(rng: np.random.Generator, size: int, density: int) -> np.ndarray:
    """Discs, bars and triangles of a warm palette over noise, uint8 [size, size, 3]; `density`: their number."""
    base = _PALETTE[rng.integers(len(_PALETTE))] * 0.5 + 90
    canvas = Image.fromarray((base + 26 * octaves(rng, size)[..., None]).clip(0, 255).astype(np.uint8))
    draw = ImageDraw.Draw(canvas)
    for _ in range(density):
        color = tuple(
            int(c) for c in (_PALETTE[rng.integers(len(_PALETTE))] * rng.uniform(0.7, 1.1)).clip(0, 255)
        )
        x, y = rng.uniform(0, size, 2)
        r = size * 0.008 * rng.pareto(2.2) + size * 0.006
        r = min(r, size * 0.09)
        kind = rng.integers(3)
        if kind == 0:
            draw.ellipse([x - r, y - r, x + r, y + r], fill=color)
        elif kind == 1:
            draw.rectangle([x - r, y - 0.4 * r, x + r, y + 0.4 * r], fill=color)
        else:
            corners = [(x + r * np.cos(a), y + r * np.sin(a)) for a in rng.uniform(0, 2 * np.pi, 3)]
            draw.polygon(corners, fill=color)
    return _grain(rng, canvas)


def planks(rng: np.random.Generator, size: int) -> np.ndarray:
    """Floor boards with grain, uint8 [size, size, 3]."""
    grain = np.repeat(octaves(rng, size)[:, :: size // 64], size // 64, axis=1)
    canvas = np.array([150.0, 110.0, 76.0]) + 16 * grain[..., None] + 9 * octaves(rng, size)[..., None]
    boards = 8
    for board in range(boards):
        rows = slice(board * size // boards, (board + 1) * size // boards)
        canvas[rows] *= rng.uniform(0.8, 1.15)
        canvas[rows.start : rows.start + size // 256] *= 0.45
        joint = int(rng.integers(size))
        canvas[rows, joint : joint + size // 256] *= 0.45
    return _grain(rng, Image.fromarray(canvas.clip(0, 255).astype(np.uint8)))


def sky(rng: np.random.Generator, size: int) -> np.ndarray:
    """Distant hills, haze and clouds by longitude (columns) and latitude (rows), uint8 [size, size, 3]."""
    latitude = ((np.arange(size) + 0.5) / size)[:, None]
    # Row v, from 0 to 1, holds the latitude pi * v, wrapped to -pi/2 .. pi/2: the upper half of the dome comes first.
    up = np.where(latitude < 0.5, latitude * 2, 0.0)[..., None]
    noise = octaves(rng, size)
    ridge = 0.035 + 0.02 * noise[size // 3]
    hills = (latitude < ridge[None, :]) | (latitude > 0.5)
    dome = np.empty((size, size, 3), np.uint8)
    for top in range(0, size, _ROWS):  # the temporary arrays of a few rows stay in the cache
        rows = slice(top, top + _ROWS)
        haze = np.array([205.0, 220.0, 232.0]) * (1 - up[rows]) + np.array([92.0, 140.0, 200.0]) * up[rows]
        image = haze + np.clip(noise[rows], 0, 1.5)[..., None] * 38
        rock = np.array([88.0, 104.0, 92.0]) + 22 * noise[::-1][rows, :, None]
        dome[rows] = np.where(hills[rows, :, None], rock, image).clip(0, 255).astype(np.uint8)
    return dome


def _grain(rng: np.random.Generator, canvas: Image.Image) -> np.ndarray:
    """The canvas with edges blurred by a texel and grain added, so that no scale is without structure."""
    soft = np.asarray(canvas.filter(ImageFilter.GaussianBlur(0.7)), np.float32)
    return (soft + rng.normal(0, 7, soft.shape[:2])[..., None]).clip(0, 255).astype(np.uint8)


def octaves(rng: np.random.Generator, size: int) -> np.ndarray:
    """Periodic noise of six octaves with unit standard deviation, float64 [size, size]."""
    total = np.zeros((size, size))
    for octave in range(2, 8):
        cells = 2**octave
        coarse = rng.normal(size=(cells, cells)).astype(np.float32)
        wide = Image.fromarray(np.pad(coarse, 2, mode="wrap"))
        inner = (2, 2, cells + 2, cells + 2)
        total += np.asarray(wide.resize((size, size), Image.Resampling.BICUBIC, inner)) * 0.62**octave
    seamless: np.ndarray = total / total.std()
    return seamless
