"""A laser scanner that stands around the still life: ranges with noise, and holes where it sees nothing."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from splatmill_worker.scene import Float
from splatmill_worker.synthetic.ray_caster import look_at, photograph, still_life

STATIONS = 3
"""Places where the scanner stands, evenly around the table."""

REACH = 15.0
"""World units, behind which nothing comes back: the dome."""

HOLES = 12
"""Dark or shining patches of each station, from which nothing comes back."""


def scan(
    width: int = 240, height: int = 180, noise: float = 0.004, seed: int = 0, stations: int = STATIONS
) -> tuple[Float, npt.NDArray[np.uint8]]:
    """Points [n,3] in the still life's world and their colours RGB [n,3], as seen from some stations together.

    width, height: rays of a station, across and down.
    noise: standard deviation of a range, in world units.
    seed: of the noise and the holes; the still life is that of seed 0.
    """
    random = np.random.default_rng(seed)
    points, colors = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)]
    for station in range(stations):
        angle = 2.0 * math.pi * (station + 0.3) / stations
        eye = np.array([3.4 * math.cos(angle), 3.4 * math.sin(angle), 1.9])
        camera = look_at(eye, np.array([0.0, 0.0, 0.2]), width, height, 0.9 * width)
        rgb, depth = photograph(still_life(0), camera, samples=1)
        back = depth < REACH
        for _ in range(HOLES):
            row, column = random.integers(height), random.integers(width)
            size = random.integers(2, max(3, height // 8), 2)
            back[row : row + size[0], column : column + size[1]] = False
        rows, columns = np.nonzero(back)
        hit = camera.unproject(columns + 0.5, rows + 0.5, depth[rows, columns].astype(np.float64))
        rays = hit - camera.center
        ranges = np.linalg.norm(rays, axis=1, keepdims=True)
        points.append(hit + rays / ranges * random.normal(0.0, noise, (len(hit), 1)))
        colors.append(rgb[rows, columns])
    return np.concatenate(points), np.concatenate(colors)
