"""The search for points over known cameras: each photo is swept against a few neighbours.

Structure from motion has points only where photos have features. Stereo adds points between them, and gives points to
captures that bring cameras without points (decisions: STEREO_POINTS).
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from splatmill_worker.images.load import load_view
from splatmill_worker.point_batches import PointBatches
from splatmill_worker.scene import WRONG_OUTLINES, Scene, View, looked_at
from splatmill_worker.sfm.callbacks import OnProgress, stop_if
from splatmill_worker.sfm.stereo.plane_sweep import MIN_AGREEING, GreyView, SweepResult, sweep
from splatmill_worker.sfm.stereo.points import StereoPoints, add, observations_per_view

Float = npt.NDArray[np.float64]

VERSION = 5
"""Version of the method; points stored under another version are searched for anew."""

ENOUGH_OBSERVATIONS = 1000
"""Mean number of known points per photo from which no more are searched for (decisions: STEREO_POINTS)."""

MIN_VIEWS = 3
"""Least number of photos for a search."""

SIDE = 320
"""Pixels of the longest side of the photos that are compared."""

NEIGHBOURS = 3
"""Neighbours that a photo is compared with, at most."""

ANGLES = 3.0, 25.0
"""Degrees between the rays of a photo and of a neighbour to the same point: smallest and largest."""

BEST_ANGLE = 9.0
"""Degrees between the rays at which a neighbour is preferred."""

MIN_AXES_COSINE = 0.7
"""Cosine between the optical axes of neighbours, at least: others show a patch at their border or not at all."""

DEPTH_MARGIN = 1.3
"""Factor by which depths are searched nearer and farther than the known points of a photo."""

MIN_KNOWN = 8
"""Known points that a photo must show for its range of depths to be taken from them."""

DEFAULT_DEPTHS = 0.3, 3.0
"""Range of depths of the other photos, in distances to the point that all cameras look at."""

TRIAL_PHOTOS = 4
"""Photos, evenly spread over the capture, after which the search is given up if their yield is too small."""

MIN_YIELD = 0.1
"""Points found per patch compared, below which the search is given up: most of so few matched by chance."""

LOADERS = 4
"""Photos decoded at a time; a request to cancel waits for these."""


def has_few_points(scene: Scene) -> bool:
    """Whether the scene has photos for stereo, and so few points that searching for more pays."""
    return len(_used(scene)) >= MIN_VIEWS and observations_per_view(scene) < ENOUGH_OBSERVATIONS


def with_stereo_points(
    scene: Scene,
    path: Path,
    on_progress: OnProgress = lambda stage, done, total, note: None,
    cancelled: Callable[[], bool] = lambda: False,
) -> Scene:
    """The scene with stereo points where it has few; they are stored at `path` and read from there the next time.

    Raises what `find_points` raises.
    """
    if not has_few_points(scene):
        return scene
    if not path.is_file():
        find_points(scene, on_progress, cancelled).save(path)
    return add(scene, StereoPoints.load(path))


def find_points(
    scene: Scene,
    on_progress: OnProgress = lambda stage, done, total, note: None,
    cancelled: Callable[[], bool] = lambda: False,
) -> StereoPoints:
    """Search for points between those of the scene.

    The search is given up, without points, when hardly any patch of the first few photos is found in their neighbours.
    This happens with cameras that move along their optical axis, and with thin or moving things.

    Photos that a data set itself holds out for tests are left out. Those held out as every n-th photo are used, as
    structure from motion uses them too.

    on_progress: called with the stage "stereo" and numbers of photos, for loading them and then for searching them.

    Raises OSError when a photo does not decode, ValueError when it has another shape than its camera, and Cancelled
    when the caller has asked to stop.
    """
    started = time.perf_counter()
    used = _used(scene)
    views = [scene.views[index] for index in used]
    count = len(views)
    grey = _grey_views(views, on_progress, cancelled)
    centers, axes = scene.centers[used], np.array([view.camera.axis for view in views])
    target = looked_at(centers, axes)
    known, batches, observers = PointBatches(), list[SweepResult](), list[_Observers]()
    known.add(scene.points)
    trial = np.unique(np.linspace(0, count - 1, min(TRIAL_PHOTOS, count)).round().astype(int))
    others = np.setdiff1d(np.arange(count), trial)
    given_up = False
    for done, index in enumerate([*trial, *others], 1):
        stop_if(cancelled)
        on_progress("stereo", done - 1, count, "photos searched for more points")
        camera = grey[index].camera
        place = camera.project(known.near(camera))
        if place.inside.sum() >= MIN_KNOWN:
            depths = place.depths[place.inside]
            near, middle, far = np.percentile(depths, [1, 50, 99]) * (1.0 / DEPTH_MARGIN, 1.0, DEPTH_MARGIN)
        else:
            middle = float(np.linalg.norm(target - centers[index]))
            near, far = DEFAULT_DEPTHS[0] * middle, DEFAULT_DEPTHS[1] * middle
        neighbours = _neighbours(index, float(middle), centers, axes)
        if len(neighbours) >= MIN_AGREEING and 0.0 < near < far:
            result = sweep(grey[index], [grey[k] for k in neighbours], place, near, far)
            batches.append(result)
            observers.append(_Observers.of(result, used[[index, *neighbours]]))
            known.add(result.points)
        if done == len(trial) and _yield(batches) < MIN_YIELD:
            given_up, batches, observers = True, [], []
            break
    points = np.concatenate([np.zeros((0, 3)), *(batch.points for batch in batches)])
    lengths = np.concatenate([np.zeros(0, np.int64), *(each.lengths for each in observers)])
    views_of_points = np.concatenate([np.zeros(0, np.int32), *(each.views for each in observers)])
    kept = _inside_outlines(points, grey)
    longest = max((max(view.camera.width, view.camera.height) for view in views), default=SIDE)
    return StereoPoints(
        points[kept],
        np.concatenate([np.zeros((0, 3), np.uint8), *(batch.colors for batch in batches)])[kept],
        np.concatenate([np.zeros(0), *(batch.errors for batch in batches)])[kept] * max(1.0, longest / SIDE),
        views_of_points[np.repeat(kept, lengths)],
        np.concatenate([[0], np.cumsum(lengths[kept])]),
        time.perf_counter() - started,
        given_up,
    )


class _Observers(NamedTuple):
    """The views that show the points found in one photo: their numbers, in order for each point, and how many."""

    views: npt.NDArray[np.int32]
    lengths: npt.NDArray[np.int64]

    @staticmethod
    def of(result: SweepResult, numbers: npt.NDArray[np.int64]) -> _Observers:
        """Those of the points of `result`. numbers: of its photo and of the neighbours, among all views."""
        order = np.argsort(numbers)
        shows = np.column_stack([np.ones(len(result.points), bool), result.agreeing])[:, order]
        return _Observers(numbers[order][np.nonzero(shows)[1]].astype(np.int32), shows.sum(axis=1))


def _inside_outlines(points: Float, views: Sequence[GreyView]) -> npt.NDArray[np.bool_]:
    """Points [n,3] that lie where no photo that shows them is transparent, bool [n]; a few photos may be wrong."""
    shown, outside = np.zeros(len(points)), np.zeros(len(points))
    for view in views if any(view.photo.alpha is not None for view in views) else ():
        place = view.camera.project(points)
        shown += place.inside
        if view.photo.alpha is not None:
            rows = np.flatnonzero(place.inside)
            at = place.rows[rows].astype(np.int64), place.columns[rows].astype(np.int64)
            outside[rows] += view.photo.alpha[at] == 0
    return outside <= WRONG_OUTLINES * shown


def _used(scene: Scene) -> npt.NDArray[np.int64]:
    """Indices of the views that take part: all but those that the data set holds out."""
    return np.array([i for i, view in enumerate(scene.views) if view.split != "test"], np.int64)


def _grey_views(
    views: Sequence[View], on_progress: OnProgress, cancelled: Callable[[], bool]
) -> list[GreyView]:
    """The views' photos at the size of the comparison. Raises Cancelled between two photos."""
    pool = ThreadPoolExecutor(min(LOADERS, os.cpu_count() or 1))
    try:
        loaded = []
        for view in pool.map(lambda view: GreyView.of(load_view(view, SIDE)), views):
            stop_if(cancelled)
            loaded.append(view)
            on_progress("stereo", len(loaded), len(views), "photos loaded to be searched for more points")
        return loaded
    finally:
        pool.shutdown(cancel_futures=True)


def _yield(batches: list[SweepResult]) -> float:
    """Points per patch compared."""
    return sum(len(batch.points) for batch in batches) / max(1, sum(batch.tried for batch in batches))


def _neighbours(index: int, depth: float, centers: Float, axes: Float) -> list[int]:
    """The views to compare view `index` with, best first: those that see its centre at `depth` from a small angle."""
    target = centers[index] + depth * axes[index]
    rays = centers - target
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    angle = np.degrees(np.arccos(np.clip(rays @ rays[index], -1.0, 1.0)))
    usable = (axes @ axes[index] > MIN_AXES_COSINE) & (angle >= ANGLES[0]) & (angle <= ANGLES[1])
    rank = np.where(usable, np.abs(np.log(np.maximum(angle, 1e-6) / BEST_ANGLE)), np.inf)
    return [int(k) for k in np.argsort(rank, kind="stable")[:NEIGHBOURS] if usable[k]]
