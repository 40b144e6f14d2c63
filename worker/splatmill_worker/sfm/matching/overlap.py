"""Which photos overlap by their cameras alone: pairs to match where poses were given."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

from splatmill_worker.scene import Camera
from splatmill_worker.sfm.matching.pairs import Pair

Float = npt.NDArray[np.float64]

PIXELS = 4
"""Positions along each side of a photo at which its overlap with others is sampled."""

DEPTHS = 10
"""Depths at each position, at equal ratios."""

NEAREST, FARTHEST = 2.0, 4.0
"""Range of the depths: from this many median distances to the nearest other camera, to this many times the radius of
all cameras. The depth of the scene is not known; the angles between the rays decide which depths count."""

ANGLES = 1.5, 30.0, 60.0
"""Degrees between the rays of two photos to a position: below the first, its depth is hardly determined (COLMAP's
limit of triangulation); up to the second, SIFT finds the same features; from the third on it finds hardly any."""

PARALLEL = 0.1
"""Weight of a position that both photos show from the same direction."""


def by_overlap(cameras: Sequence[Camera], partners: int, photos: Iterable[int] | None = None) -> set[Pair]:
    """Each photo with up to `partners` others that show most of the space in front of it at angles good for matching.

    photos: indices of the photos to pair with others; None: of all.

    Positions in front of each photo, at depths from near to far, are projected into the others. Empty where all cameras
    are in one place.
    """
    centers = np.array([camera.center for camera in cameras]).reshape(-1, 3)
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    radius = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max(initial=0.0))
    # Cameras of a rig or a stereo pair may coincide; the nearest one elsewhere gives the scale.
    nearest = np.where(apart > 1e-6 * radius, apart, np.inf).min(axis=1, initial=np.inf)
    if not (radius > 0.0 and np.isfinite(nearest).any()):
        return set()
    near = NEAREST * float(np.median(nearest[np.isfinite(nearest)]))
    depths = np.geomspace(near, max(FARTHEST * radius, 4.0 * near), DEPTHS)
    chosen: set[Pair] = set()
    for index in range(len(cameras)) if photos is None else photos:
        score = _overlap(_positions(cameras[index], depths), centers[index], cameras)
        score[index] = 0.0
        for other in np.argsort(-score, kind="stable")[:partners]:
            if score[other] > 0.0:
                chosen.add((min(index, int(other)), max(index, int(other))))
    return chosen


def _positions(camera: Camera, depths: Float) -> Float:
    """Positions [k,3] in the world on a grid of the photo's pixels, at each of the `depths`."""
    share = (np.arange(PIXELS) + 0.5) / PIXELS
    column, row, depth = (
        grid.ravel() for grid in np.meshgrid(share * camera.width, share * camera.height, depths)
    )
    return camera.unproject(column, row, depth)


def _overlap(positions: Float, center: Float, cameras: Sequence[Camera]) -> Float:
    """For each camera, the weighted number of `positions` that it shows, which another camera at `center` shows too."""
    own = center - positions
    own_distance = np.linalg.norm(own, axis=1)
    scores = np.zeros(len(cameras))
    for index, camera in enumerate(cameras):
        inside = camera.project(positions).inside
        if not inside.any():
            continue
        ray = camera.center - positions[inside]
        distance = np.linalg.norm(ray, axis=1)
        cosine = (ray * own[inside]).sum(axis=1) / np.maximum(distance * own_distance[inside], 1e-12)
        angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        scores[index] = np.interp(angle, (0.0, *ANGLES), (PARALLEL, 1.0, 1.0, 0.0)).sum()
    return scores
