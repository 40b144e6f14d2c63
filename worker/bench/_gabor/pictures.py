"""Ten pictures drawn from a seed: textures that repeat or do not, text, smooth colours, and a rendered still life."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from splatmill_worker.synthetic import ray_caster

Array = npt.NDArray[np.float64]

SAMPLES = 3
"""Samples of a pixel, both ways."""


def picture(name: str, side: int) -> npt.NDArray[np.uint8]:
    """One of PICTURES, `side` pixels wide and high, uint8 [side, side, 3]. The same name gives the same picture."""
    random = np.random.default_rng(sorted(PICTURES).index(name))
    return (np.clip(PICTURES[name](side, random), 0.0, 1.0) * 255.0).round().astype(np.uint8)


def _stripes(side: int, _: np.random.Generator) -> Array:
    x, y = _grid(side)
    bend = 3.0 * np.sin(3.0 * math.pi * y / side)
    wave = np.cos(2.0 * math.pi * (0.13 * (x + bend) + 0.05 * y))
    return _down(_between(wave > 0.0, (0.85, 0.8, 0.7), (0.2, 0.25, 0.45)))


def _knit(side: int, _: np.random.Generator) -> Array:
    """Two crossing sinusoids, the finer one of a frequency that drifts from 0.16 to 0.24 cycles per pixel."""
    x, y = _grid(side)
    fine = 2.0 * math.pi * (0.16 * x + 0.04 * x * x / side) + 2.0 * np.sin(2.0 * math.pi * y / side)
    coarse = 0.18 * math.pi * y + fine / 2.0
    return _down(
        _between(0.5 + 0.3 * np.cos(fine) + 0.15 * np.cos(coarse), (0.35, 0.1, 0.12), (0.95, 0.85, 0.75))
    )


def _weave(side: int, _: np.random.Generator) -> Array:
    x, y = _grid(side)
    i, j = np.floor(x / 7.0), np.floor(y / 7.0)
    over = (i + j) % 2 == 0
    across = np.where(over, x / 7.0 - i, y / 7.0 - j) - 0.5
    shade = 1.0 - 2.2 * across * across
    return _down(_between(~over, (0.75, 0.6, 0.4), (0.45, 0.3, 0.2)) * shade[..., None])


def _brick(side: int, random: np.random.Generator) -> Array:
    x, y = _grid(side)
    row = np.floor(y / 9.0)
    shifted = x + (row % 2) * 10.0
    column = np.floor(shifted / 20.0)
    mortar = (y - 9.0 * row < 1.5) | (shifted - 20.0 * column < 1.5)
    tones = random.random((int(row.max()) + 1, int(column.max()) + 1))
    wall = _between(tones[row.astype(int), column.astype(int)], (0.5, 0.2, 0.15), (0.7, 0.35, 0.25))
    wall = np.where(mortar[..., None], (0.75, 0.73, 0.7), wall)
    return _down(wall) + 0.02 * _noise(side, 0.5, random, 1)


def _foliage(side: int, random: np.random.Generator) -> Array:
    noise = _noise(side, 0.9, random, 3)
    color: Array = (0.65 + 0.29 * noise[..., :1]) * np.array([0.45, 0.75, 0.3]) + 0.04 * noise
    return color


def _grass(side: int, random: np.random.Generator) -> Array:
    canvas = Image.new("RGB", (side * SAMPLES, side * SAMPLES), (40, 60, 30))
    draw = ImageDraw.Draw(canvas)
    for _ in range(side * side // 12):
        x, y = random.uniform(0.0, side * SAMPLES, 2)
        angle, length = random.normal(-math.pi / 2.0, 0.25), SAMPLES * random.uniform(6.0, 16.0)
        tip = x + length * math.cos(angle), y + length * math.sin(angle)
        shade = random.uniform(0.5, 1.1)
        draw.line([x, y, *tip], (int(110 * shade), int(170 * shade), int(70 * shade)), SAMPLES)
    return _down(np.asarray(canvas, np.float64) / 255.0)


def _text(side: int, random: np.random.Generator) -> Array:
    canvas = Image.new("RGB", (side * SAMPLES, side * SAMPLES), (250, 248, 240))
    draw = ImageDraw.Draw(canvas)
    font = ImageFont.load_default(11 * SAMPLES)
    words = [
        "gaussians",
        "blend",
        "front",
        "to",
        "back",
        "until",
        "the",
        "light",
        "of",
        "a",
        "pixel",
        "is",
        "used",
        "up",
    ]
    for y in range(2, side, 13):
        line = " ".join(random.choice(words, 6 + side // 16))
        draw.text((2 * SAMPLES, y * SAMPLES), line, (30, 30, 40), font)
    return _down(np.asarray(canvas, np.float64) / 255.0)


def _smooth(side: int, random: np.random.Generator) -> Array:
    return 0.5 + 0.15 * _noise(side, 3.0, random, 3)


def _still_life(side: int, _: np.random.Generator) -> Array:
    camera = ray_caster.orbit(8, side, side, 0)[1]
    return np.asarray(ray_caster.picture(ray_caster.still_life(0), camera, SAMPLES), np.float64) / 255.0


def _fence(side: int, random: np.random.Generator) -> Array:
    """A smooth sky, boards before it, and grainy ground: a bit of each."""
    x, y = _grid(side)
    boards = (
        (np.cos(2.0 * math.pi * x / 5.0 * (1.0 + 0.3 * x / side)) > -0.2)
        & (y / side > 0.35)
        & (y / side < 0.8)
    )
    ground = y / side > 0.78
    out = _between(y / side, (0.45, 0.65, 0.95), (0.9, 0.9, 0.95))
    out = np.where(ground[..., None], (0.35, 0.45, 0.25), out)
    grain = np.where(np.arange(side) / side > 0.78, 0.08, 0.005)[:, None, None]
    return _down(np.where(boards[..., None], (0.5, 0.35, 0.2), out)) + grain * _noise(side, 0.6, random, 1)


PICTURES: dict[str, Callable[[int, np.random.Generator], Array]] = {
    "stripes": _stripes,
    "knit": _knit,
    "weave": _weave,
    "brick": _brick,
    "fence": _fence,
    "grass": _grass,
    "foliage": _foliage,
    "text": _text,
    "smooth": _smooth,
    "still life": _still_life,
}


def _grid(side: int) -> tuple[Array, Array]:
    """x and y of the samples, in pixels."""
    y, x = np.mgrid[0 : side * SAMPLES, 0 : side * SAMPLES]
    return (x + 0.5) / SAMPLES, (y + 0.5) / SAMPLES


def _down(samples: Array) -> Array:
    """The mean of each pixel's samples."""
    side = len(samples) // SAMPLES
    mean: Array = samples.reshape(side, SAMPLES, side, SAMPLES, -1).mean(axis=(1, 3))
    return mean


def _between(share: npt.NDArray[np.generic], first: Sequence[float], second: Sequence[float]) -> Array:
    """The mixture of two colours with `share` [H, W] of the second."""
    mixed: Array = np.asarray(first) + share.astype(np.float64)[..., None] * (
        np.asarray(second) - np.asarray(first)
    )
    return mixed


def _noise(side: int, slope: float, random: np.random.Generator, channels: int) -> Array:
    """Noise [side, side, channels] whose amplitude falls with the frequency to the power `slope`, of deviation 1."""
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None, :])
    frequency[0, 0] = 1.0
    white = random.standard_normal((channels, side, side))
    noise: Array = np.moveaxis(np.fft.irfft2(np.fft.rfft2(white) / frequency**slope, (side, side)), 0, -1)
    noise -= noise.mean(axis=(0, 1))
    noise /= noise.std(axis=(0, 1))
    return noise
