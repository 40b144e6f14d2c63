"""Robust iterative closest points with a scale, from the points of a scene to the surfaces of a scan.

Pairs go from the scene to the scan: structure from motion places points on a part of the surfaces, and a scan has
points on all that it saw. Points of the scene that the scan does not have are left out by a limit on the distance,
which falls with the distances (Chetverikov et al. 2002). Each step takes the distances to the planes of the scan (Chen
and Medioni 1992), and with a small weight those to its points, which determine the step where the planes leave it open.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatmill_worker.colmap import pycolmap
from splatmill_worker.scene import Float, Similarity
from splatmill_worker.sfm.alignment.cloud import Cloud
from splatmill_worker.sfm.world.georeference import umeyama

NEIGHBOURS = 6
"""Nearest points of the scan among which one of the same colour is searched."""

AROUND = 12
"""Points of the scan that a plane is fitted to."""

POINTS = 0.1
"""Weight of the squared distance to a point of the scan, beside that to its plane."""

FEWEST = 12
"""Pairs below which a step is not taken."""


@dataclass(frozen=True)
class Pairs:
    """The points of a scene that a scan has, under a similarity.

    rows: of the scene [n].
    partners: of the scan [n].
    distances: between them, in units of the scene [n].
    """

    rows: npt.NDArray[np.intp]
    partners: npt.NDArray[np.intp]
    distances: Float


def nearest(
    scene: Cloud, scan: Cloud, similarity: Similarity, limit: float
) -> tuple[Float, npt.NDArray[np.intp]]:
    """Distances, in units of the scan, and rows of the points of the scan next to each point of the scene, within
    `limit` [n,NEIGHBOURS]; past the end where there are fewer."""
    moved = (scene.points - similarity.translation) @ similarity.rotation / similarity.scale
    distances, rows = scan.tree.query(moved, k=NEIGHBOURS, distance_upper_bound=limit / similarity.scale)
    return distances, rows


def pairs(scene: Cloud, scan: Cloud, similarity: Similarity, limit: float) -> Pairs:
    """The points of the scene with a point of the scan, of the same colour, within `limit`."""
    distances, near = nearest(scene, scan, similarity, limit)
    alike = scan.alike(near, scene.colors)
    first = np.argmax(alike, axis=1)
    rows = np.flatnonzero(alike.any(axis=1))
    return Pairs(rows, near[rows, first[rows]], similarity.scale * distances[rows, first[rows]])


def refined(
    scene: Cloud, scan: Cloud, similarity: Similarity, limit: float, steps: int, normals: Float | None = None
) -> Similarity:
    """The similarity after some steps from a first one; the same where too few points find a partner.

    limit: distance of two partners in the first step, in units of the scene, at most. It falls to three times the
        median distance, but not under the spacing of the scan.
    normals: of the scan's surfaces [n,3]; None: distances to points alone count, which converges from farther away.
    """
    for _ in range(steps):
        matches = pairs(scene, scan, similarity, limit)
        if len(matches.rows) < FEWEST:
            return similarity
        source, target = scan.points[matches.partners], scene.points[matches.rows]
        step = (
            _to_points(source, target)
            if normals is None
            else _to_planes(similarity, source, normals[matches.partners], target, limit)
        )
        if step is None:
            return similarity
        similarity = step
        least = max(1.5 * scan.spacing * similarity.scale, 3.0 * float(np.median(matches.distances)))
        limit = min(limit, max(0.8 * limit, least))
    return similarity


def normals_of(scan: Cloud) -> Float:
    """Unit normals [n,3] of the planes through the nearest points of each point, of either sign."""
    count = min(AROUND, len(scan.points))
    _, near = scan.tree.query(scan.points, k=count, workers=-1)
    around = scan.points[near.reshape(len(scan.points), -1)]
    around = around - around.mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    normals: Float = vectors[:, :, 0]
    return normals


def _to_points(source: Float, target: Float) -> Similarity | None:
    """The similarity with the least squared distances, of the scale that spreads both alike.

    The scale of least squares is too small where pairs are wrong: errors shrink the covariance, not the spreads (Horn
    1987).
    """
    fit = umeyama(source, target)
    if fit is None:
        return None
    rotation = fit[0]
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    scale = float(np.sqrt((b**2).sum() / (a**2).sum()))
    return Similarity(rotation, scale, target.mean(axis=0) - scale * rotation @ source.mean(axis=0))


def _to_planes(
    similarity: Similarity, source: Float, normals: Float, target: Float, limit: float
) -> Similarity | None:
    """One step of Gauss and Newton with weights of Geman and McClure, over rotation, logarithmic scale and place."""
    moved = similarity.points(source)
    middle = moved.mean(axis=0)
    arms = moved - middle
    size = float(np.sqrt((arms**2).sum(axis=1).mean()))
    if not size > 0.0:
        return None
    directions = normals @ similarity.rotation.T
    errors = target - moved
    off = (errors * directions).sum(axis=1)
    sigma = max(1.4826 * float(np.median(np.abs(off))), 1e-3 * limit)
    weights = 1.0 / (1.0 + (off / (2.0 * sigma)) ** 2) ** 2

    def rows(axes: Float) -> Float:
        """How far arms move along `axes` [n,3] by a turn, a growth and a shift, each by `size`."""
        return np.column_stack([np.cross(arms, axes) / size, (arms * axes).sum(axis=1) / size, axes])

    system = [rows(directions) * np.sqrt(weights)[:, None]]
    right = [off * np.sqrt(weights)]
    for axis in np.eye(3):
        system.append(np.sqrt(POINTS * weights)[:, None] * rows(np.broadcast_to(axis, arms.shape)))
        right.append(np.sqrt(POINTS * weights) * (errors @ axis))
    step = np.linalg.lstsq(np.concatenate(system), np.concatenate(right), rcond=None)[0]
    rotation = pycolmap.Rotation3d(step[:3] / size).matrix()
    growth, shift = float(np.exp(step[3] / size)), step[4:]
    change = Similarity(rotation, growth, middle + shift - growth * rotation @ middle)
    return similarity.then(change)
