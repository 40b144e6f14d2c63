"""Points in batches, so that a camera need not project all points of a large scene to find those that it shows."""

from __future__ import annotations

import numpy as np
import torch

from splatmill_worker.kernels.morton import morton_order
from splatmill_worker.scene import Camera, Float

BATCH = 128
"""Points of a batch, where many are added at once."""

SLACK = 1e-9
"""Relative error of rounding that the test of a batch allows for."""


class PointBatches:
    """Points to which more are added, each batch with a ball around it."""

    def __init__(self) -> None:
        self._batches: list[Float] = []
        self._balls = np.zeros((0, 4))

    def add(self, points: Float) -> None:
        """Add points [n,3]. Many are divided into batches of neighbours; those that are not finite are left out."""
        points = points[np.isfinite(points).all(axis=1)]
        if len(points) > BATCH:
            points = points[morton_order(torch.from_numpy(points), cubic=True).numpy()]
        balls = [self._balls]
        for first in range(0, len(points), BATCH):
            batch = points[first : first + BATCH]
            middle = (batch.min(axis=0) + batch.max(axis=0)) / 2
            radius = np.sqrt(np.square(batch - middle).sum(axis=1).max())
            self._batches.append(batch)
            balls.append(np.array([[*middle, radius + SLACK * (radius + np.abs(middle).max())]]))
        self._balls = np.concatenate(balls)

    def near(self, camera: Camera) -> Float:
        """All points [n,3] that fall into the photo of `camera`, and some that do not, in any order."""
        x, y, z = camera.to_camera(self._balls[:, :3]).T
        radius = self._balls[:, 3]
        shown = z > -radius
        # The four planes through the centre of the camera and a border of the photo.
        for across, focal, first, size in (
            (x, camera.fx, camera.cx, camera.width),
            (y, camera.fy, camera.cy, camera.height),
        ):
            last = size - first
            shown &= focal * across + first * z >= -radius * np.hypot(focal, first)
            shown &= last * z - focal * across >= -radius * np.hypot(focal, last)
        return np.concatenate([np.zeros((0, 3)), *(self._batches[index] for index in np.flatnonzero(shown))])
