"""Planted movers: things that stand among the still life in one photo and elsewhere in the next; and their pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatmill_worker.synthetic.light import SPARED
from splatmill_worker.synthetic.ray_caster import Box, Cylinder, Sphere
from splatmill_worker.synthetic.textures import MipMap, painted

Thing = Box | Cylinder | Sphere

CHANGED = 8
"""Grey levels of 255 by which any channel of a pixel differs from the photo without movers, to count as moved: what a
mover covers and what its shadow darkens."""


@dataclass(frozen=True)
class Movers:
    """What passes by while the photos are taken.

    share: share of the photos that show any, 0 to 1.
    each: number of things in such a photo.
    size: radius of a thing, in half widths of the table.
    """

    share: float = 0.4
    each: int = 2
    size: float = 0.25

    def passing(self, photos: int, seed: int = 0) -> list[tuple[Thing, ...]]:
        """What each of `photos` photos shows beside the still life; nothing in every photo of number SPARED n.

        Each time it is somewhere else, beside or above the table, and painted anew.
        """
        random = np.random.default_rng([seed, 11])
        return [
            tuple(self._thing(random) for _ in range(self.each))
            if number % SPARED and random.uniform() < self.share
            else ()
            for number in range(photos)
        ]

    def _thing(self, random: np.random.Generator) -> Thing:
        size = self.size * random.uniform(0.7, 1.4)
        angle, ring = random.uniform(0.0, 2.0 * math.pi), random.uniform(0.2, 2.2)
        center = (ring * math.cos(angle), ring * math.sin(angle), size + random.uniform(0.0, 0.8))
        texture = MipMap(painted(random, 256, density=60))
        kind = random.integers(3)
        if kind == 0:
            return Sphere(center, size, texture, 1.0)
        if kind == 1:
            return Cylinder(center, 0.6 * size, size, texture, 0.9)
        half = (size, 0.6 * size, 0.8 * size)
        return Box(center, half, float(random.uniform(0.0, 3.0)), texture, 0.9)


def changed(photo: npt.NDArray[np.uint8], without: npt.NDArray[np.uint8]) -> npt.NDArray[np.bool_]:
    """The pixels [H, W] of a photo uint8 [H, W, 3] that movers changed, against the photo without them."""
    differences = np.abs(photo.astype(np.int16) - without.astype(np.int16))
    moved: npt.NDArray[np.bool_] = differences.max(axis=2) > CHANGED
    return moved
