"""Where down is, from how people hold cameras: level from left to right, and seldom upside down."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatmill_worker.scene import Float, looked_at

ROLL = math.radians(4.0)
"""Standard deviation of the angle by which photos that are held level are not."""

PITCH = math.radians(40.0)
"""Standard deviation of the angle by which photos look up or down. It counts only where the photos look almost one way:
their x axes then leave open how far they look up or down."""

LEVEL = math.sin(math.radians(12.0))
"""Cosine between down and the x axis of a photo, up to which the photo counts as level."""

AGREEING = 0.6
"""Share of the photos that must be level for the direction to be relied on."""

TURNED = math.sin(math.radians(10.0)) ** 2
"""Mean square of the components of the x axes across their main direction (eigenvalue), from which they tell down
without an assumption about pitch."""

OVERHEAD = 0.2
"""Mean cosine between down and the photos' y axes, below which photos look straight down or up, so that their y axes do
not tell one from the other."""

PAIRS = 400
"""Pairs of photos from whose x axes a direction is tried."""


@dataclass(frozen=True)
class Down:
    """Where down is.

    direction: a unit vector [3] in the world of the cameras.
    level: number of photos that are level by it.
    doubt: why the direction may be wrong, as the end of a sentence; None where nothing speaks against it.
    """

    direction: Float
    level: int
    doubt: str | None


def down_of(rotations: Float) -> Down:
    """The direction that is most probably down, from the world-to-camera rotations [n,3,3] of upright photos.

    Photos are level: the direction is across their x axes (exact for photos that look all ways, however far they look
    down), and photos that are not are left out of it. Where the x axes are parallel, the direction is the one that is
    also across the viewing directions, and this is a doubt.
    """
    x, y, z = rotations[:, 0], rotations[:, 1], rotations[:, 2]
    candidates = _candidates(x, y)
    costs = [float(_cost(direction, x, y, z).sum()) for direction in candidates]
    direction = candidates[int(np.argmin(costs))]
    spread = 0.0
    for _ in range(10):
        kept = _level(direction, x, y)
        if not kept.any():
            break
        form = x[kept].T @ x[kept] / kept.sum()
        spread = float(np.linalg.eigvalsh(form)[1])
        if spread < TURNED:
            form += (ROLL / PITCH) ** 2 * (z[kept].T @ z[kept]) / kept.sum()
        refined = np.linalg.eigh(form)[1][:, 0]
        direction = refined if refined @ direction > 0.0 else -refined
    kept = _level(direction, x, y)
    upright = float((y[kept] @ direction).mean()) if kept.any() else 0.0
    overhead = abs(upright) < OVERHEAD
    # Photos from above are common, photos of the sky are not.
    if (float((z @ direction).mean()) if overhead else upright) < 0.0:
        direction = -direction
    level, count = int(kept.sum()), len(rotations)
    doubt = None
    if level < AGREEING * count:
        doubt = f"only {level} of {count} photos are level by any one direction, the others are rolled"
    elif overhead:
        doubt = "the photos look straight down or straight up, and are taken to look down"
    elif spread < TURNED:
        doubt = "the photos look almost one way, and are taken to look neither up nor down on the whole"
    return Down(direction, level, doubt)


def _candidates(x: Float, y: Float) -> Float:
    """Directions [k,3] to try: those across the x axes of two photos, and what each photo has below it."""
    random = np.random.default_rng(0)
    first, second = random.integers(0, len(x), (2, PAIRS))
    across = np.cross(x[first], x[second])
    lengths = np.linalg.norm(across, axis=1)
    # Sine of the angle: nearer to parallel, the roll of the photos decides the direction.
    wide = lengths > 0.1
    across = across[wide] / lengths[wide, None]
    return np.concatenate([across, -across, y])


def _level(direction: Float, x: Float, y: Float) -> npt.NDArray[np.bool_]:
    """Which photos are level, and not upside down [n]."""
    level: npt.NDArray[np.bool_] = (np.abs(x @ direction) < LEVEL) & (y @ direction > -LEVEL)
    return level


def _cost(direction: Float, x: Float, y: Float, z: Float) -> Float:
    """Negative logarithms of the probability of each photo [n]; a photo that is not level costs a constant."""
    worst = (LEVEL / ROLL) ** 2
    level = np.where(_level(direction, x, y), (x @ direction / ROLL) ** 2, worst)
    cost: Float = np.minimum(level, worst) + (z @ direction / PITCH) ** 2
    return cost


def focus_of(centers: Float, axes: Float, points: Float) -> Float:
    """The point [3] that cameras look at, from their positions and viewing directions [n,3].

    It has the least sum of distances to the optical axes, so that single photos that look elsewhere do not move it.
    Where the axes are almost parallel, or meet behind the cameras, it is the median of the scene's points [m,3], and
    without points it lies ahead of the cameras, at three times their mean distance from their mean.
    """
    middle = centers.mean(axis=0)
    spread = float(np.linalg.norm(centers - middle, axis=1).mean()) or 1.0
    alignment = np.linalg.eigvalsh(axes.T @ axes / len(axes))[-1]  # 1 for parallel axes
    if alignment < 1.0 - 1e-2:
        weights = np.ones(len(axes))
        for _ in range(20):
            point = looked_at(centers, axes, ridge=0.0, weights=weights)
            offsets = point - centers
            across = offsets - np.einsum("nj,nj->n", offsets, axes)[:, None] * axes
            weights = 1.0 / np.maximum(np.linalg.norm(across, axis=1), 1e-3 * spread)
        if np.median(np.einsum("nj,nj->n", offsets, axes)) > 0.1 * spread:
            return point
    if len(points):
        median: Float = np.median(points, axis=0)
        return median
    ahead = axes.mean(axis=0)
    ahead /= float(np.linalg.norm(ahead)) or 1.0
    focus: Float = middle + 3 * spread * ahead
    return focus
