"""Random Gaussians where cameras look, for scenes without points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatmill_worker.scene import Camera, looked_at
from splatmill_worker.splat.start.points import ENOUGH_POINTS
from splatmill_worker.splat.views import Target

Float = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Pixels = npt.NDArray[np.uint8]

RANDOM_GAUSSIANS = 20_000

CANDIDATES = 4
"""Points tried for each one kept."""

HULL_VIEWS = 32
"""Photos that are asked about every candidate; more do not change a hull's shape visibly."""


def sample_frusta(targets: Sequence[Target], count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Random points [count, 3] and colours uint8 [count, 3] where cameras look, for scenes without points.

    Candidates are drawn along the rays of random pixels, between 0.2 and 1.8 times the distance of what the
    cameras look at. Those that most cameras see are kept; a camera whose photo is transparent there does not
    see them, so that an object on a transparent background starts as its visual hull: the box around the
    candidates that no camera sees through is filled anew. Colours are the means of what the cameras show.
    """
    random = np.random.default_rng(seed)
    some = targets[:: max(1, len(targets) // HULL_VIEWS)]
    cameras = [target.camera for target in targets]
    centers = np.array([camera.center for camera in cameras])
    target = looked_at(centers, np.array([camera.axis for camera in cameras]))
    points = _along_rays(cameras, median_distance(centers, target), CANDIDATES * count, random)
    rank, color = _occupancy(some, points)
    solid = points[rank > 0.5 * rank.max()]
    if any(target.alpha is not None for target in targets) and len(solid) >= ENOUGH_POINTS:
        low, high = solid.min(axis=0), solid.max(axis=0)
        margin = 0.1 * (high - low)
        points = random.uniform(low - margin, high + margin, (CANDIDATES * count, 3))
        rank, color = _occupancy(some, points)
    order = np.argsort(-rank - random.uniform(0.0, 0.5, len(rank)), kind="stable")[:count]
    return torch.from_numpy(points[order]).float(), torch.from_numpy(color[order])


def _occupancy(targets: Sequence[Target], points: Float) -> tuple[Float, Pixels]:
    """How many photos show something at each point, minus those that see through it, and the mean colour there."""
    seen, missed = np.zeros(len(points)), np.zeros(len(points))
    color = np.zeros((len(points), 3))
    for target in targets:
        inside, rows, columns = _pixels(target.camera, points)
        cover = np.ones(len(rows)) if target.alpha is None else target.alpha.numpy()[rows, columns] / 255.0
        seen[inside] += cover
        missed[inside] += 1.0 - cover
        color[inside] += cover[:, None] * target.rgb.numpy()[rows, columns]
    mean = color / np.maximum(seen, 1e-9)[:, None]
    mean[seen <= 0] = 128.0
    # One camera that sees through a point outweighs several that see something there.
    return seen - 4.0 * missed, mean.clip(0, 255).astype(np.uint8)


def median_distance(centers: Float, target: Float) -> float:
    """The median distance from camera positions [n, 3] to the point `target` [3]; 1 where that is zero."""
    distance = float(np.median(np.linalg.norm(centers - target, axis=1)))
    return distance if distance > 1e-6 else 1.0


def _along_rays(cameras: Sequence[Camera], distance: float, count: int, random: np.random.Generator) -> Float:
    """Points [count, 3] along the rays of random pixels, uniform in the volume that the cameras see."""
    points = np.empty((count, 3))
    pick = random.integers(len(cameras), size=count)
    for i, camera in enumerate(cameras):
        rows = np.flatnonzero(pick == i)
        u = random.uniform(0, camera.width, len(rows))
        v = random.uniform(0, camera.height, len(rows))
        z = distance * np.cbrt(random.uniform(0.2**3, 1.8**3, len(rows)))
        points[rows] = camera.unproject(u, v, z)
    return points


def _pixels(camera: Camera, points: Float) -> tuple[Index, Index, Index]:
    """Indices of the points that fall on the photo, with the row and the column that they fall on."""
    seen = camera.project(points)
    inside = np.flatnonzero(seen.inside)
    return inside, seen.rows[inside].astype(np.int64), seen.columns[inside].astype(np.int64)
