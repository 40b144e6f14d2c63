"""Points for given cameras: features are matched between overlapping photos and triangulated; no camera is moved."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np
import numpy.typing as npt

from splatmill_worker.colmap import pycolmap
from splatmill_worker.scene import Camera, Source, View
from splatmill_worker.sfm.callbacks import OnProgress, watched
from splatmill_worker.sfm.matching import overlap, pairs, two_view
from splatmill_worker.sfm.options import Effort
from splatmill_worker.sfm.posed.judged.conventions import better
from splatmill_worker.sfm.posed.judged.searched import database_of, epipolar_errors, features_of, model_of
from splatmill_worker.sfm.run import torch_threads
from splatmill_worker.sfm.sift import Features

Float = npt.NDArray[np.float64]

CANDIDATES = 24
"""Photos per photo, by the overlap of their cameras, whose largest features are compared before pairs are chosen."""

MIN_VIEWS_OF_TRACK = 3
"""Photos that must show a point where there are more than two: two photos alone agree by chance."""


CONTRADICTED = 0.5
"""Share of the matches that the given cameras explain, below which the cameras are called wrong."""


@dataclass(frozen=True)
class Triangulated:
    """What matching and triangulation found.

    points: positions in the world [n,3].
    colors: mean over the photos that observe the point, RGB [n,3].
    errors: mean reprojection error, in pixels of the full-size photos [n].
    tracks: indices of the views that observe each point.
    matches: number of matches that some two-view geometry explains, over all pairs.
    pairs: number of verified pairs.
    agreeing: number of these matches that the given cameras explain too, with the same limit of the error.
    disagreement: median epipolar error of these matches under the given cameras, pixels of full-size photos.
    features: median number of features of a photo.
    transparent: number of photos with transparent pixels.
    convention: where the cameras explain few matches, the one that explains most of them, of `conventions`; else "".
    convention_share: the share of the matches that it explains.
    seconds: time by stage.
    """

    points: Float
    colors: npt.NDArray[np.uint8]
    errors: Float
    tracks: tuple[tuple[int, ...], ...]
    matches: int
    pairs: int
    agreeing: int
    disagreement: float
    features: float
    transparent: int
    convention: str
    convention_share: float
    seconds: dict[str, float]


def contradicted(agreeing: int, matches: int) -> bool:
    """Whether the given cameras explain so few of the matches that they are wrong."""
    return matches > 0 and agreeing < CONTRADICTED * matches


def triangulate(
    views: Sequence[View],
    effort: Effort,
    *,
    source: Source = "transforms",
    seed: int = 0,
    on_progress: OnProgress = lambda stage, done, total, note: None,
    cancelled: Callable[[], bool] = lambda: False,
) -> Triangulated:
    """Points that the photos of `views` show, by the given cameras.

    Features are those of `effort`, on undistorted photos. Pairs are chosen by the overlap of the cameras and by a quick
    comparison of features.

    source: of the cameras.
    on_progress: called with the stages features, matching and triangulation.

    Raises OSError and ValueError for photos as `load_view` does, and Cancelled.
    """
    seconds: dict[str, float] = {}
    threads = os.cpu_count() or 1
    longest = max(max(view.camera.width, view.camera.height) for view in views)
    with ThreadPoolExecutor(threads) as pool, torch_threads(1), tempfile.TemporaryDirectory() as folder:
        started = perf_counter()
        photos = features_of(views, effort, pool, on_progress, cancelled)
        seconds["features"] = perf_counter() - started
        started = perf_counter()
        cameras = [each.camera for each in photos]
        features = [each.features for each in photos]
        model = model_of(cameras)
        path = Path(folder) / "database.db"
        with closing(database_of(path, model, features)) as database:
            matched = two_view.match_pairs(
                _pairs(cameras, features, effort.partners, pool, cancelled),
                features,
                {index: index + 1 for index in range(len(views))},
                database,
                seed,
                pool,
                lambda done, total: on_progress("matching", done, total, "pairs matched"),
                cancelled,
            )
            verified = [pair for pair, outcome in matched.items() if outcome.inliers >= two_view.MIN_INLIERS]
            errors = epipolar_errors(verified, cameras, features, database)
            bound = two_view.max_error(max(max(camera.width, camera.height) for camera in cameras))
            convention, share = "", 0.0
            if contradicted(int((errors <= bound).sum()), len(errors)):
                convention, share = better(source, verified, cameras, features, database, bound)
        seconds["matching"] = perf_counter() - started
        started = perf_counter()
        on_progress("triangulation", 0, len(views), "photos triangulated")
        if verified:
            _triangulate(model, path, Path(folder), len(views), seed, cancelled)
        seconds["triangulation"] = perf_counter() - started
    side = max(max(camera.width, camera.height) for camera in cameras)
    enlarged = max(1.0, longest / side)
    tracks, colors = [], []
    points = list(model.points3D.values())
    for point in points:
        observations = [(element.image_id - 1, element.point2D_idx) for element in point.track.elements]
        tracks.append(tuple(sorted({view for view, _ in observations})))
        colors.append(np.mean([photos[view].colors[row] for view, row in observations], axis=0))
    return Triangulated(
        np.array([point.xyz for point in points]).reshape(-1, 3),
        np.array(colors).reshape(-1, 3).round().astype(np.uint8),
        enlarged * np.array([point.error for point in points]),
        tuple(tracks),
        len(errors),
        len(verified),
        int((errors <= bound).sum()),
        enlarged * float(np.median(errors)) if len(errors) else np.nan,
        float(np.median([len(each.scales) for each in features])),
        sum(each.transparent for each in photos),
        convention,
        share,
        {stage: round(value, 3) for stage, value in seconds.items()},
    )


def _pairs(
    cameras: Sequence[Camera],
    features: Sequence[Features],
    partners: int,
    pool: ThreadPoolExecutor,
    cancelled: Callable[[], bool],
) -> set[pairs.Pair]:
    """The pairs to match in full."""
    if len(cameras) <= pairs.EXHAUSTIVE_UP_TO:
        return set(pairs.exhaustive(len(cameras)))
    candidates = overlap.by_overlap(cameras, max(CANDIDATES, 2 * partners))
    scores = pairs.matches_of_largest(candidates, features, pool, lambda done, total: None, cancelled)
    return pairs.best_partners(scores, len(cameras), partners)


def _triangulate(
    model: pycolmap.Reconstruction,
    database: Path,
    folder: Path,
    views: int,
    seed: int,
    cancelled: Callable[[], bool],
) -> None:
    """Triangulate into `model`, and remove points that too few photos observe."""
    options = pycolmap.IncrementalPipelineOptions()
    options.min_num_matches = two_view.MIN_INLIERS
    options.random_seed = seed
    options.extract_colors = False
    options.triangulation.ignore_two_view_tracks = views > 2
    watched(
        lambda token: pycolmap.triangulate_points(
            model, database, folder, folder, True, options, False, token
        ),
        cancelled,
    )
    least = min(views, MIN_VIEWS_OF_TRACK)
    for number in [number for number, point in model.points3D.items() if point.track.length() < least]:
        model.delete_point3D(number)
