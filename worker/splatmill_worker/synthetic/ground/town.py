"""The town: a grid of blocks without end, of which each follows from the seed and its place alone."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from splatmill_worker.synthetic.ground import paint
from splatmill_worker.synthetic.ground.paint import BLOCK, LANE, STOREY, WALK, Mark, rectangle
from splatmill_worker.synthetic.ground.solids import Ball, Face, Hull, Solid, looks
from splatmill_worker.synthetic.ground.texture import Texture

Float = npt.NDArray[np.float64]

HIGHEST = 22.0
"""Height in metres that nothing in the town exceeds."""

KEPT = 32
"""Blocks whose ground stays painted, at 6 MB each; those that a photo shows are at most half of them."""

_WALLS = ((198, 186, 166), (172, 120, 96), (206, 204, 198), (150, 158, 160), (214, 190, 140))
_ROOFS = ((150, 84, 62), (96, 90, 88), (126, 98, 76))
_FLATS = ((150, 148, 142), (112, 114, 118), (172, 166, 152))
_LEAVES = ((74, 100, 44), (92, 116, 52), (60, 86, 48), (128, 118, 54))
_CARS = (
    (0.9, 0.9, 0.9),
    (0.25, 0.26, 0.28),
    (0.6, 0.62, 0.65),
    (0.7, 0.12, 0.1),
    (0.15, 0.25, 0.5),
    (0.1, 0.1, 0.1),
)
_KINDS = ("houses", "flats", "park", "works")
_SHARES = (0.45, 0.28, 0.13, 0.14)
_LOW = LANE + WALK
_INNER = BLOCK - 2 * _LOW
"""Where the part of a block that streets leave begins, and its width, in metres."""


@dataclass(frozen=True)
class Block:
    """What stands in a block, and the marks on its ground.

    corners: of boxes around the solids, float64 [n, 8, 3].
    looks, textures: of the solids' faces, as `solids.looks` returns them.
    """

    solids: tuple[Solid, ...]
    marks: tuple[Mark, ...]
    corners: Float
    looks: npt.NDArray[np.float32]
    textures: npt.NDArray[np.int64]


class Town:
    """The town of a seed; blocks are numbered from the origin to the east and to the north, negative ones too."""

    def __init__(self, seed: int) -> None:
        random = np.random.default_rng([seed, 20])
        self._seed = seed
        self.textures: list[Texture] = []
        self.facades = self._add([paint.facade(random, color) for color in _WALLS])
        self.tiles = self._add([paint.tiles(random, color) for color in _ROOFS])
        self.flats = self._add([paint.flat_roof(random, color) for color in _FLATS])
        self.leaves = self._add([paint.leaves(random, color) for color in _LEAVES])
        (self.lacquer,) = self._add([paint.lacquer(random)])
        self.block = lru_cache(maxsize=None)(self._block)
        self.ground = lru_cache(maxsize=KEPT)(self._ground)

    def _add(self, textures: list[Texture]) -> range:
        """Keep textures; returns their numbers."""
        self.textures += textures
        return range(len(self.textures) - len(textures), len(self.textures))

    def _random(self, east: int, north: int, purpose: int) -> np.random.Generator:
        places = [2 * abs(n) + (n < 0) for n in (east, north)]
        return np.random.default_rng([self._seed, purpose, *places])

    def _ground(self, east: int, north: int) -> Texture:
        """The ground of a block; its south-western corner is the texture's first."""
        return paint.ground(self._random(east, north, 22), self.block(east, north).marks)

    def _block(self, east: int, north: int) -> Block:
        work = _Builder(self._random(east, north, 21), (east * BLOCK, north * BLOCK), self)
        kind = work.random.choice(len(_KINDS), p=_SHARES)
        getattr(work, _KINDS[kind])()
        work.street()
        corners = [
            [(x, y, z) for x in (s.lowest[0], s.highest[0]) for y in (s.lowest[1], s.highest[1])
             for z in (s.lowest[2], s.highest[2])]
            for s in work.solids
        ]  # fmt: skip
        return Block(
            tuple(work.solids), tuple(work.marks), np.array(corners).reshape(-1, 8, 3), *looks(work.solids)
        )


class _Builder:
    """Puts solids and marks into one block, at places in metres from its south-western corner."""

    def __init__(self, random: np.random.Generator, origin: tuple[float, float], town: Town) -> None:
        self.random, self.origin, self.town = random, origin, town
        self.solids: list[Solid] = []
        self.marks: list[Mark] = []

    def houses(self) -> None:
        """Six plots in two rows, each with a house, a garden and trees."""
        width, depth = _INNER / 3, _INNER / 2
        for column in range(3):
            for row in range(2):
                left, low = _LOW + column * width, _LOW + row * depth
                self._lawn(left + 0.2, low + 0.2, width - 0.4, depth - 0.4)
                size = self.random.uniform([7.5, 8.0], [10.5, 12.5])
                x = left + width / 2 + self.random.uniform(-1.2, 1.2)
                y = low + (0.40 if row == 0 else 0.60) * depth + self.random.uniform(-1.0, 1.0)
                drive = left + self.random.uniform(0.8, 2.0)
                self._mark(rectangle(drive, low if row == 0 else low + depth - 9, 2.8, 9), self._grey())
                self.house(x, y, *size)
                self.car(drive + 1.4, low + 4.0 if row == 0 else low + depth - 4.0, math.pi / 2, 0.6)
                for _ in range(self.random.integers(2, 5)):
                    self.tree(left + self.random.uniform(1, width - 1), low + (0.86 if row == 0 else 0.14) * depth
                              + self.random.uniform(-2, 2))  # fmt: skip

    def flats(self) -> None:
        """Two long buildings with flat roofs, a yard with parked cars between them, and trees."""
        self._lawn(_LOW, _LOW, _INNER, _INNER)
        self._mark(rectangle(_LOW + 2, BLOCK / 2 - 5.5, _INNER - 4, 11), self._grey(0.62))
        for place in (_LOW + 9.5, BLOCK - _LOW - 9.5):
            length, depth = self.random.uniform(30, 44), self.random.uniform(10, 13)
            x = BLOCK / 2 + self.random.uniform(-3, 3)
            self._mark(
                rectangle(x - length / 2 - 1, place - depth / 2 - 1, length + 2, depth + 2), self._grey(1.1)
            )
            self.flat(x, place, length, depth, int(self.random.integers(3, 7)))
        for k in range(16):
            self.car(_LOW + 5 + 2.7 * k, BLOCK / 2 + 2.6 * (1 if k % 2 else -1), math.pi / 2, 0.7)
        for _ in range(10):
            x, y = (
                self.random.uniform(_LOW, BLOCK - _LOW),
                self.random.choice([_LOW + 1.5, BLOCK - _LOW - 1.5]),
            )
            self.tree(x, float(y))

    def park(self) -> None:
        """Meadows with paths, beds and many trees."""
        self._lawn(_LOW, _LOW, _INNER, _INNER)
        for _ in range(3):
            ends = self.random.uniform(_LOW, BLOCK - _LOW, (2, 2))
            side = np.array([ends[0, 1] - ends[1, 1], ends[1, 0] - ends[0, 0]])
            side *= 0.9 / np.linalg.norm(side)
            a, b = ends + side, ends - side
            self._mark([tuple(p) for p in (a[0], a[1], b[1], b[0])], (178.0, 160.0, 128.0))
        for _ in range(30):
            x, y = self.random.uniform(_LOW + 2, BLOCK - _LOW - 2, 2).tolist()
            self.tree(x, y, 1.25)

    def works(self) -> None:
        """A hall with a flat roof, and a yard with marked places for cars."""
        self._mark(rectangle(_LOW, _LOW, _INNER, _INNER), self._grey(0.66))
        self.flat(BLOCK / 2, BLOCK - _LOW - 14, self.random.uniform(36, 48), self.random.uniform(20, 25), 2)
        for row in range(2):
            for k in range(18):
                x, y = _LOW + 2 + 2.7 * k, _LOW + 2.5 + row * 10
                self._mark(rectangle(x, y, 0.12, 5), paint.WHITE)
                self.car(x + 1.35, y + 2.5, math.pi / 2, 0.62)

    def street(self) -> None:
        """Trees of the walks and parked cars, along all four sides."""
        for turned in (False, True):
            for side in (LANE - 1.1, BLOCK - LANE + 1.1):
                for along in np.arange(9.0, BLOCK - 10.0, 5.6):
                    x, y = (side, along) if turned else (along, side)
                    self.car(float(x), float(y), math.pi / 2 if turned else 0.0, 0.35)
            for side in (LANE + 1.2, BLOCK - LANE - 1.2):
                for along in np.arange(10.0, BLOCK - 10.0, 9.0):
                    if self.random.uniform() < 0.4:
                        x, y = (side, float(along)) if turned else (float(along), side)
                        self.tree(x, y, 0.8)

    def house(self, x: float, y: float, width: float, depth: float) -> None:
        """A house with a saddle roof, whose ridge runs along its depth, and a chimney."""
        turn, height = self.random.uniform(-0.08, 0.08), STOREY * self.random.integers(1, 3)
        slope = math.tan(math.radians(self.random.uniform(30, 44)))
        ridge = height + slope * width / 2
        length = math.hypot(1.0, slope)
        wall, roof = self._choose(self.town.facades), self._choose(self.town.tiles)
        tint, shade = self._tint(), self._tint()
        faces = self._walls(wall, width, depth, turn, tint)
        normals = [*_sides(), (1 / length * slope, 0.0, 1 / length), (-1 / length * slope, 0.0, 1 / length)]
        limits = [width / 2, width / 2, depth / 2, depth / 2, ridge / length, ridge / length]
        offset = self._offset()
        for side in (1, -1):
            down = _turned((side / length, 0.0, -slope / length), turn)
            faces.append(Face(roof, _turned((0.0, 1.0, 0.0), turn), down, offset, shade))
        self._hull(x, y, turn, normals, limits, faces, (width, depth, ridge))
        c, s = math.cos(turn), math.sin(turn)
        a, b = width / 5, depth * self.random.uniform(-0.3, 0.3)
        self.box(x + c * a - s * b, y + s * a + c * b, 0.8, 0.6, ridge + 0.7, turn, wall, (0.7, 0.5, 0.45))

    def flat(self, x: float, y: float, width: float, depth: float, storeys: int) -> None:
        """A building with a flat roof, on which plant stands."""
        turn, height = self.random.uniform(-0.03, 0.03), storeys * STOREY * 0.999
        wall, roof = self._choose(self.town.facades), self._choose(self.town.flats)
        self.box(x, y, width, depth, height, turn, wall, self._tint(), roof)
        c, s = math.cos(turn), math.sin(turn)
        for _ in range(self.random.integers(5, 10)):
            a, b = self.random.uniform(-0.44, 0.44) * width, self.random.uniform(-0.4, 0.4) * depth
            size = self.random.uniform([0.8, 0.8, 0.5], [2.8, 2.2, 1.7])
            top = min(height + size[2], HIGHEST)
            place = x + c * a - s * b, y + s * a + c * b
            self.box(*place, size[0], size[1], top, turn, self.town.lacquer, self._tint(), None, height)

    def car(self, x: float, y: float, turn: float, likely: float) -> None:
        """A car at this place, with this likelihood: a body, and a cabin with dark windows."""
        if self.random.uniform() > likely:
            return
        turn += self.random.uniform(-0.06, 0.06) + math.pi * self.random.integers(2)
        tint = _CARS[self.random.integers(len(_CARS))]
        paint_, dark = self.town.lacquer, (0.14, 0.16, 0.19)
        length, width = self.random.uniform(3.9, 4.7), self.random.uniform(1.7, 1.85)
        back = -0.35
        x_, y_ = x + back * math.cos(turn), y + back * math.sin(turn)
        self.box(x, y, length, width, 0.85, turn, paint_, tint, paint_)
        self.box(x_, y_, 0.52 * length, 0.88 * width, 1.42, turn, paint_, dark, paint_, 0.85, tint)

    def tree(self, x: float, y: float, size: float = 1.0) -> None:
        """A crown of three balls, and the trunk below."""
        leaves, tint = self._choose(self.town.leaves), self._tint(0.2)
        radius = size * self.random.uniform(1.2, 2.6)
        height = radius * self.random.uniform(1.5, 2.2) + 0.8
        self.box(x, y, 0.3, 0.3, height, 0.0, self.town.lacquer, (0.36, 0.28, 0.2))
        face = Face(leaves, (1.0, 0.0, 0.7), (0.0, 1.0, 0.7), self._offset(), tint)
        for k in range(3):
            r = radius * (1.0 if k == 0 else self.random.uniform(0.5, 0.75))
            side = np.zeros(2) if k == 0 else self.random.uniform(-0.7, 0.7, 2) * radius
            up = height + (0.0 if k == 0 else self.random.uniform(-0.2, 0.6) * radius)
            center = (self.origin[0] + x + side[0], self.origin[1] + y + side[1], up)
            self.solids.append(Ball(center, (r, r, r * self.random.uniform(0.8, 1.15)), face))

    def box(
        self, x: float, y: float, width: float, depth: float, top: float, turn: float, wall: int,
        tint: tuple[float, float, float], roof: int | None = None, base: float = 0.0,
        roof_tint: tuple[float, float, float] | None = None,
    ) -> None:  # fmt: skip
        """An upright box from `base` to `top`."""
        faces = self._walls(wall, width, depth, turn, tint)
        u, v = _turned((1.0, 0.0, 0.0), turn), _turned((0.0, 1.0, 0.0), turn)
        plain = roof_tint or (tint if roof in (None, wall) else self._tint(0.1))
        faces.append(Face(wall if roof is None else roof, u, v, self._offset(), plain))
        normals, limits = [*_sides(), (0.0, 0.0, 1.0)], [width / 2, width / 2, depth / 2, depth / 2, top]
        if base > 0.0:
            normals.append((0.0, 0.0, -1.0))
            limits.append(-base)
            faces.append(faces[-1])
        self._hull(x, y, turn, normals, limits, faces, (width, depth, top), base)

    def _walls(
        self, texture: int, width: float, depth: float, turn: float, tint: tuple[float, float, float]
    ) -> list[Face]:
        """The four walls of a box; bays begin at its corners."""
        along, faces = (_turned((0.0, 1.0, 0.0), turn), _turned((1.0, 0.0, 0.0), turn)), []
        for side in range(4):
            bays = STOREY * float(self.random.integers(20))
            start = (depth if side < 2 else width) / 2 + bays
            faces.append(Face(texture, along[side // 2], (0.0, 0.0, 1.0), (start, STOREY * side * 4), tint))
        return faces

    def _hull(
        self, x: float, y: float, turn: float, normals: list[tuple[float, float, float]], limits: list[float],
        faces: list[Face], size: tuple[float, float, float], base: float = 0.0,
    ) -> None:  # fmt: skip
        """A hull given around its own upright axis, turned and moved to (x, y) of the block."""
        place = np.array([self.origin[0] + x, self.origin[1] + y, 0.0])
        turned = np.array([_turned(normal, turn) for normal in normals])
        moved = np.array(limits) + turned @ place
        # Textures stand still on the walls: offsets count from the hull's axis.
        there = tuple(
            Face(
                f.texture,
                f.u,
                f.v,
                (f.offset[0] - float(place @ f.u), f.offset[1] - float(place @ f.v)),
                f.tint,
            )
            for f in faces
        )
        c, s = abs(math.cos(turn)), abs(math.sin(turn))
        half = (c * size[0] + s * size[1]) / 2, (s * size[0] + c * size[1]) / 2
        lowest = (place[0] - half[0], place[1] - half[1], base)
        highest = (place[0] + half[0], place[1] + half[1], size[2])
        self.solids.append(Hull(turned, moved, there, lowest, highest))

    def _lawn(self, x: float, y: float, width: float, height: float) -> None:
        """Grass of one colour with darker and bare spots."""
        grass = paint.GRASSES[self.random.integers(len(paint.GRASSES))]
        shade = self.random.uniform(0.85, 1.15)
        self._mark(rectangle(x, y, width, height), (grass[0] * shade, grass[1] * shade, grass[2] * shade))
        for _ in range(int(width * height / 12)):
            at, size = self.random.uniform([x, y], [x + width, y + height]), self.random.uniform(0.2, 1.3, 2)
            turns = np.sort(self.random.uniform(0, 2 * math.pi, 7))
            spot = [
                (float(at[0] + size[0] * math.cos(a)), float(at[1] + size[1] * math.sin(a))) for a in turns
            ]
            base = paint.SOIL if self.random.uniform() < 0.25 else grass
            f = self.random.uniform(0.7, 1.25)
            self._mark(spot, (base[0] * f, base[1] * f, base[2] * f))

    def _mark(self, shape: paint.Shape, color: paint.Color) -> None:
        self.marks.append(Mark(shape, color))

    def _grey(self, factor: float = 0.9) -> paint.Color:
        level = 150.0 * factor * self.random.uniform(0.85, 1.15)
        return level, 0.985 * level, 0.96 * level

    def _tint(self, spread: float = 0.15) -> tuple[float, float, float]:
        level = self.random.uniform(1.0 - spread, 1.0 + spread)
        red, green, blue = (level * self.random.uniform(0.95, 1.05, 3)).tolist()
        return red, green, blue

    def _offset(self) -> tuple[float, float]:
        a, b = self.random.uniform(0.0, BLOCK, 2).tolist()
        return a, b

    def _choose(self, textures: range) -> int:
        return textures[self.random.integers(len(textures))]


def _sides() -> list[tuple[float, float, float]]:
    """Outward normals of four upright walls."""
    return [(1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0)]


def _turned(vector: tuple[float, float, float], turn: float) -> tuple[float, float, float]:
    """A vector turned about the upright axis by `turn` radians."""
    c, s = math.cos(turn), math.sin(turn)
    return c * vector[0] - s * vector[1], s * vector[0] + c * vector[1], vector[2]
