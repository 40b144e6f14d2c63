"""Paints the textures of the town: the ground of a block, facades, roofs, leaves and lacquer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from splatmill_worker.synthetic.ground.texture import Texture
from splatmill_worker.synthetic.textures import octaves

BLOCK = 64.0
"""Width of a block in metres, from the middle of one street to the next; also of the widest textures."""

TEXELS = 16
"""Texels per metre of the ground and of facades."""

STOREY = 3.2
"""Height of a storey and width of a window's bay, in metres: a facade's texture is a whole number of them wide."""

LANE, WALK = 3.6, 2.2
"""Widths of half a street and of the walk beside it, in metres."""

Color = tuple[float, float, float]
Shape = Sequence[tuple[float, float]]

ASPHALT, PAVEMENT, WHITE = (88, 88, 92), (158, 154, 146), (226, 226, 220)
SOIL, GRASSES = (112, 92, 68), ((92, 112, 58), (106, 122, 66), (122, 124, 76), (82, 104, 56))


@dataclass(frozen=True)
class Mark:
    """An area of the ground of one colour, in metres from the block's south-western corner."""

    shape: Shape
    color: Color


def rectangle(x: float, y: float, width: float, height: float) -> Shape:
    """The corners of a level rectangle, of which the first is at (x, y)."""
    return ((x, y), (x + width, y), (x + width, y + height), (x, y + height))


def ground(random: np.random.Generator, marks: Sequence[Mark]) -> Texture:
    """A block's ground: grass, its marks in their order, and the streets around it."""
    size = round(BLOCK * TEXELS)
    canvas = Image.new("RGB", (size, size), _whole(GRASSES[random.integers(len(GRASSES))]))
    draw = ImageDraw.Draw(canvas)

    def fill(shape: Shape, color: Color) -> None:
        draw.polygon([(x * TEXELS, y * TEXELS) for x, y in shape], fill=_whole(color))

    for mark in marks:
        fill(mark.shape, mark.color)
    _streets(random, fill)
    flat = np.asarray(canvas, np.float32)
    rough = np.where(flat[..., 1] > flat[..., 0] + 4, 1.7, 1.0)[..., None].astype(np.float32)
    return Texture(_weathered(random, flat, rough), BLOCK)


def _streets(random: np.random.Generator, fill: object) -> None:
    assert callable(fill)
    edge = LANE + WALK
    for turned in (False, True):

        def put(x: float, y: float, width: float, height: float, color: Color, turned: bool = turned) -> None:
            fill(rectangle(y, x, height, width) if turned else rectangle(x, y, width, height), color)

        for side in (0.0, BLOCK - LANE):
            walk = LANE if side == 0.0 else BLOCK - edge
            put(LANE, walk, BLOCK - 2 * LANE, WALK, PAVEMENT)
            for joint in np.arange(LANE, BLOCK - LANE, 1.1):
                shade = random.uniform(0.86, 1.08)
                put(joint, walk, 1.04, WALK - 0.12, _times(PAVEMENT, shade))
    for turned in (False, True):

        def put(x: float, y: float, width: float, height: float, color: Color, turned: bool = turned) -> None:
            fill(rectangle(y, x, height, width) if turned else rectangle(x, y, width, height), color)

        for side in (0.0, BLOCK - LANE):
            put(0.0, side, BLOCK, LANE, ASPHALT)
            for _ in range(7):
                width, height = random.uniform(0.5, 5.0), random.uniform(0.3, 1.5)
                where = random.uniform(0.0, BLOCK - width), side + random.uniform(0.1, LANE - height)
                put(*where, width, height, _times(ASPHALT, random.uniform(0.72, 1.25)))
            middle = 0.0 if side == 0.0 else BLOCK - 0.08
            for dash in np.arange(8.0, BLOCK - 10.0, 5.0):
                put(dash, middle, 2.6, 0.08, WHITE)
            for stripe in np.arange(0.5, LANE - 0.3, 1.0):
                for crossing in (LANE + 0.4, BLOCK - LANE - 2.8):
                    put(crossing, side + stripe, 2.4, 0.5, _times(WHITE, random.uniform(0.8, 1.0)))
    for _ in range(26):  # covers and stains of the streets
        along, across = random.uniform(0, BLOCK), random.uniform(0.3, LANE - 0.3)
        x, y = (along, across) if random.uniform() < 0.5 else (across, along)
        if random.uniform() < 0.5:
            x, y = BLOCK - x, BLOCK - y
        radius, shade = random.uniform(0.15, 0.5), random.uniform(0.5, 1.4)
        turns = np.arange(9) * (2 * math.pi / 9)
        fill([(x + radius * math.cos(a), y + radius * math.sin(a)) for a in turns], _times(ASPHALT, shade))
    for _ in range(14):  # cracks
        along, across = random.uniform(0, BLOCK), random.uniform(0.2, LANE - 0.2)
        steps = np.cumsum(random.normal(0.0, 0.12, 20)) + across
        line = [(along + 0.35 * k, float(np.clip(y, 0.0, LANE))) for k, y in enumerate(steps)]
        back = [(x + 0.05, y + 0.08) for x, y in reversed(line)]
        shape = [*line, *back]
        if random.uniform() < 0.5:
            shape = [(y, x) for x, y in shape]
        if random.uniform() < 0.5:
            shape = [(BLOCK - x, BLOCK - y) for x, y in shape]
        fill(shape, _times(ASPHALT, 0.6))


def facade(random: np.random.Generator, wall: Color) -> Texture:
    """A wall with a window in most of its bays, each with other curtains and stains."""
    size, bay = round(BLOCK * TEXELS), round(STOREY * TEXELS)
    canvas = Image.new("RGB", (size, size), _whole(wall))
    draw = ImageDraw.Draw(canvas)
    for row in range(0, size, bay):
        draw.rectangle([0, row, size, row + 2], fill=_whole(_times(wall, 0.8)))
        for column in range(0, size, bay):
            draw.rectangle(
                [column, row, column + bay, row + bay], fill=_whole(_times(wall, random.uniform(0.93, 1.05)))
            )
            if random.uniform() < 0.12:
                continue
            left, right = column + int(random.integers(8, 14)), column + bay - int(random.integers(8, 14))
            low, high = row + int(random.integers(12, 18)), row + bay - int(random.integers(8, 12))
            draw.rectangle(
                [left - 2, low - 2, right + 2, high + 2], fill=_whole(_times(WHITE, random.uniform(0.7, 1)))
            )
            glass = np.array([52.0, 66.0, 80.0]) * random.uniform(0.5, 1.5)
            draw.rectangle([left, low, right, high], fill=_whole(glass))
            if random.uniform() < 0.5:
                hang = int(random.integers(low + 2, high))
                draw.rectangle([left, hang, right, high], fill=_whole(random.uniform(110, 225, 3)))
            middle = (left + right) // 2
            draw.rectangle([middle, low, middle + 1, high], fill=_whole(WHITE))
    return Texture(_weathered(random, np.asarray(canvas, np.float32), np.float32(0.6)), BLOCK)


def tiles(random: np.random.Generator, color: Color) -> Texture:
    """Rows of roof tiles, 32 metres wide, each a little darker or lighter than the next."""
    size, along, across = 512, 5, 6
    shades = random.normal(1.0, 0.10, (size // along + 1, size // across + 1))
    rows, columns = np.arange(size), np.arange(size)
    picture = shades[np.ix_(rows // along, columns // across)]
    picture = picture * np.where(rows % along == 0, 0.72, 1.0)[:, None]
    flat = np.array(color, np.float32) * picture[..., None].astype(np.float32)
    return Texture(_weathered(random, flat, np.float32(1.0)), BLOCK / 2)


def flat_roof(random: np.random.Generator, color: Color) -> Texture:
    """Sheets of roofing with seams, puddles and repairs."""
    size = round(BLOCK * TEXELS)
    canvas = Image.new("RGB", (size, size), _whole(color))
    draw = ImageDraw.Draw(canvas)
    for seam in range(0, size, 24):
        draw.rectangle([seam, 0, seam + 23, size], fill=_whole(_times(color, random.uniform(0.9, 1.08))))
        draw.rectangle([seam, 0, seam + 1, size], fill=_whole(_times(color, 0.75)))
    for _ in range(240):
        x, y, width, height = *random.uniform(0, size, 2), *random.uniform(4, 44, 2)
        shade = random.uniform(0.68, 1.25)
        paint = draw.ellipse if random.uniform() < 0.4 else draw.rectangle
        paint([x, y, x + width, y + height], fill=_whole(_times(color, shade)))
    return Texture(_weathered(random, np.asarray(canvas, np.float32), np.float32(1.2)), BLOCK)


def leaves(random: np.random.Generator, color: Color) -> Texture:
    """Foliage, 16 metres wide: bright leaves over dark gaps."""
    size = 256
    spots = octaves(random, size) + random.normal(0.0, 0.8, (size, size))
    shade = np.clip(1.0 + 0.30 * spots, 0.25, 1.9)[..., None]
    return Texture((np.array(color) * shade).clip(0, 255).astype(np.uint8), 16.0)


def lacquer(random: np.random.Generator) -> Texture:
    """A bright even paint with faint dirt, 8 metres wide, to be tinted."""
    shade = 215.0 + 8.0 * octaves(random, 128)[..., None] + np.zeros(3)
    return Texture(shade.clip(0, 255).astype(np.uint8), 8.0)


def _weathered(random: np.random.Generator, flat: np.ndarray, rough: np.ndarray | np.float32) -> np.ndarray:
    """Flat colours with spots of every size, from metres to a texel, uint8; `rough`: the factor of their contrast."""
    size = len(flat)
    spots = 0.07 * octaves(random, size).astype(np.float32)
    coarse = random.normal(0.0, 0.07, (size // 4, size // 4)).astype(np.float32)
    fine = random.normal(0.0, 0.07, (size // 2, size // 2)).astype(np.float32)
    spots += coarse.repeat(4, 0).repeat(4, 1) + fine.repeat(2, 0).repeat(2, 1)
    spots += random.normal(0.0, 0.04, (size, size)).astype(np.float32)
    weathered: np.ndarray = (flat * (1.0 + rough * spots[..., None])).clip(0, 255).astype(np.uint8)
    return weathered


def _whole(color: Sequence[float] | np.ndarray) -> tuple[int, int, int]:
    red, green, blue = (int(min(max(part, 0.0), 255.0)) for part in color)
    return red, green, blue


def _times(color: Color, factor: float) -> Color:
    return color[0] * factor, color[1] * factor, color[2] * factor
