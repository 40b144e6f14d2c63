"""Random points where cameras look, for scenes without points."""

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
"""Gaussians that training starts with where a scene has too few points."""

CANDIDATES = 4
"""Points drawn for each one kept."""

HULL_VIEWS = 32
"""Least number of photos against which every candidate is tested; all of them where there are fewer."""

SEEN_THROUGH = 4.0
"""Weight of a photo that is transparent at a point, relative to one that shows something there."""


def sample_frusta(targets: Sequence[Target], count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Random points [count, 3] and colours uint8 [count, 3] where cameras look, for scenes without points.

    Candidates are drawn along the rays of random pixels. Their depths are 0.2 to 1.8 times the median distance of the
    cameras from the point that they look at. Those that most cameras see are kept. A camera whose photo is transparent
    at a candidate counts against it, so that an object on a transparent background starts as its visual hull:
    candidates are then drawn again, in the box around those in the hull. The colour of a point is the mean of what the
    photos show there.
    """
    random = np.random.default_rng(seed)
    some = targets[:: max(1, len(targets) // HULL_VIEWS)]
    cameras = [target.camera for target in targets]
    centers = np.array([camera.center for camera in cameras])
    target = looked_at(centers, np.array([camera.axis for camera in cameras]))
    points = _along_rays(cameras, median_distance(centers, target), CANDIDATES * count, random)
    score, color = _scored(some, points)
    solid = points[score > 0.5 * score.max()]
    if any(target.alpha is not None for target in targets) and len(solid) >= ENOUGH_POINTS:
        low, high = solid.min(axis=0), solid.max(axis=0)
        margin = 0.1 * (high - low)
        points = random.uniform(low - margin, high + margin, (CANDIDATES * count, 3))
        score, color = _scored(some, points)
    # The random term breaks ties: the scores of opaque photos are whole numbers.
    order = np.argsort(-score - random.uniform(0.0, 0.5, len(score)), kind="stable")[:count]
    return torch.from_numpy(points[order]).float(), torch.from_numpy(color[order])


def _scored(targets: Sequence[Target], points: Float) -> tuple[Float, Pixels]:
    """Scores [n] of `points` [n, 3] and their mean colours uint8 [n, 3].

    The score is the number of photos that show something at the point, less SEEN_THROUGH times the number of those that
    are transparent there: one photo that sees through a point outweighs several that show something near it.
    """
    hits, missed = np.zeros(len(points)), np.zeros(len(points))
    color = np.zeros((len(points), 3))
    for target in targets:
        inside, rows, columns = _pixels(target.camera, points)
        cover = np.ones(len(rows)) if target.alpha is None else target.alpha.numpy()[rows, columns] / 255.0
        hits[inside] += cover
        missed[inside] += 1.0 - cover
        color[inside] += cover[:, None] * target.rgb.numpy()[rows, columns]
    mean = color / np.maximum(hits, 1e-9)[:, None]
    mean[hits <= 0] = 128.0
    return hits - SEEN_THROUGH * missed, mean.clip(0, 255).astype(np.uint8)


def median_distance(centers: Float, target: Float) -> float:
    """The median distance from camera positions [n, 3] to the point `target` [3]; 1 where that is zero."""
    distance = float(np.median(np.linalg.norm(centers - target, axis=1)))
    return distance if distance > 1e-6 else 1.0


def _along_rays(cameras: Sequence[Camera], distance: float, count: int, random: np.random.Generator) -> Float:
    """Points [count, 3] along the rays of random pixels, uniform in the volume of each camera's frustum."""
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
    projection = camera.project(points)
    inside = np.flatnonzero(projection.inside)
    return inside, projection.rows[inside].astype(np.int64), projection.columns[inside].astype(np.int64)
