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
from splatmill_worker.images.load import Photo, load_view
from splatmill_worker.scene import Camera, View
from splatmill_worker.sfm.callbacks import OnProgress, native_token, stop_if
from splatmill_worker.sfm.features import Features
from splatmill_worker.sfm.matching import overlap, pairs, two_view
from splatmill_worker.sfm.options import Effort, fitted
from splatmill_worker.sfm.run import torch_threads

Float = npt.NDArray[np.float64]

CANDIDATES = 24
"""Photos per photo, by the overlap of their cameras, whose largest features are compared before pairs are chosen."""

GREY = (0.5, 0.5, 0.5)
"""RGB behind transparent photos: the outline of the object then has less contrast than over black or white."""

OPAQUE = 250
"""Alpha (0 to 255) from which a feature counts: on the outline of an object it lies at no fixed place."""

MIN_VIEWS_OF_TRACK = 3
"""Photos that must show a point where there are more than two: two photos alone agree by chance."""


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
    seconds: dict[str, float]


@dataclass(frozen=True)
class _Found:
    """A photo's features, their colours [n,3], the pinhole camera at the size of the search, and its transparency."""

    camera: Camera
    features: Features
    colors: npt.NDArray[np.uint8]
    transparent: bool


def triangulate(
    views: Sequence[View],
    effort: Effort,
    *,
    seed: int = 0,
    on_progress: OnProgress = lambda stage, done, total, note: None,
    cancelled: Callable[[], bool] = lambda: False,
) -> Triangulated:
    """Points that the photos of `views` show, by the given cameras.

    Features are those of `effort`, on undistorted photos. Pairs are chosen by the overlap of the cameras and by a quick
    comparison of features.

    on_progress: called with the stages features, matching and triangulation.

    Raises OSError and ValueError for photos as `load_view` does, and Cancelled.
    """
    seconds: dict[str, float] = {}
    threads = os.cpu_count() or 1
    longest = max(max(view.camera.width, view.camera.height) for view in views)
    with ThreadPoolExecutor(threads) as pool, torch_threads(1), tempfile.TemporaryDirectory() as folder:
        started = perf_counter()
        found = _features(views, fitted(effort, longest), pool, on_progress, cancelled)
        seconds["features"] = perf_counter() - started
        started = perf_counter()
        cameras = [each.camera for each in found]
        features = [each.features for each in found]
        model = _model(cameras)
        path = Path(folder) / "database.db"
        with closing(_database(path, model, features)) as database:
            matched = two_view.match_pairs(
                _pairs(cameras, features, effort.partners, pool, cancelled),
                features,
                {index: index + 1 for index in range(len(views))},
                database,
                effort.features,
                seed,
                pool,
                lambda done, total: on_progress("matching", done, total, "pairs matched"),
                cancelled,
            )
            verified = [pair for pair, outcome in matched.items() if outcome.inliers >= two_view.MIN_INLIERS]
            errors = _epipolar_errors(verified, cameras, features, database)
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
        seen = [(element.image_id - 1, element.point2D_idx) for element in point.track.elements]
        tracks.append(tuple(sorted({view for view, _ in seen})))
        colors.append(np.mean([found[view].colors[row] for view, row in seen], axis=0))
    return Triangulated(
        np.array([point.xyz for point in points]).reshape(-1, 3),
        np.array(colors).reshape(-1, 3).round().astype(np.uint8),
        enlarged * np.array([point.error for point in points]),
        tuple(tracks),
        len(errors),
        len(verified),
        int((errors <= two_view.max_error(side)).sum()),
        enlarged * float(np.median(errors)) if len(errors) else np.nan,
        float(np.median([len(each.scales) for each in features])),
        sum(each.transparent for each in found),
        {stage: round(value, 3) for stage, value in seconds.items()},
    )


def _features(
    views: Sequence[View],
    effort: Effort,
    pool: ThreadPoolExecutor,
    on_progress: OnProgress,
    cancelled: Callable[[], bool],
) -> list[_Found]:
    """The features of every photo that lie on unmasked, opaque pixels. Raises Cancelled between two photos."""
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = 1
    options.sift.max_num_features = effort.features
    options.sift.first_octave = effort.first_octave
    options.sift.max_num_orientations = effort.orientations

    def find(view: View) -> _Found:
        stop_if(cancelled)
        return _found(load_view(view, effort.side, background=GREY), options)

    found = []
    for each in pool.map(find, views):
        found.append(each)
        on_progress("features", len(found), len(views), views[len(found) - 1].name)
    return found


def _found(photo: Photo, options: pycolmap.FeatureExtractionOptions) -> _Found:
    luma = np.ascontiguousarray((photo.rgb @ np.array([0.299, 0.587, 0.114]) + 0.5).astype(np.uint8))
    extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    keypoints, descriptors = extractor.extract_from_uint8_array(luma)
    place = np.array([(each.x, each.y, each.compute_scale()) for each in keypoints]).reshape(-1, 3)
    column = place[:, 0].astype(np.int64).clip(0, photo.camera.width - 1)
    row = place[:, 1].astype(np.int64).clip(0, photo.camera.height - 1)
    kept = np.ones(len(place), bool)
    if photo.mask is not None:
        kept &= photo.mask[row, column]
    if photo.alpha is not None:
        kept &= photo.alpha[row, column] >= OPAQUE
    # A feature of several orientations would be several observations of one point.
    _, first = np.unique(place, axis=0, return_index=True)
    kept &= np.isin(np.arange(len(place)), first)
    return _Found(
        photo.camera,
        Features(
            place[kept, :2],
            place[kept, 2].astype(np.float32),
            np.asarray(descriptors.data, np.uint8).reshape(-1, 128)[kept],
        ),
        photo.rgb[row[kept], column[kept]],
        photo.alpha is not None and bool((photo.alpha < 255).any()),
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


def _model(cameras: Sequence[Camera]) -> pycolmap.Reconstruction:
    """COLMAP's model of the cameras, without points; view i has the camera, the image and the frame i + 1."""
    model = pycolmap.Reconstruction()
    for number, camera in enumerate(cameras, 1):
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(
                model="PINHOLE",
                width=camera.width,
                height=camera.height,
                params=[camera.fx, camera.fy, camera.cx, camera.cy],
                camera_id=number,
            )
        )
        model.add_image_with_trivial_frame(
            pycolmap.Image(name=f"{number:06d}", camera_id=number, image_id=number),
            pycolmap.Rigid3d(camera.viewmat[:3]),
        )
    return model


def _database(path: Path, model: pycolmap.Reconstruction, features: Sequence[Features]) -> pycolmap.Database:
    """A database of the model's cameras and images, and of the features."""
    database = pycolmap.Database.open(path)
    for number, found in enumerate(features, 1):
        database.write_camera(model.cameras[number], use_camera_id=True)
        database.write_rig(model.rigs[number], use_rig_id=True)
        database.write_frame(model.frames[number], use_frame_id=True)
        database.write_image(model.images[number], use_image_id=True)
        database.write_keypoints(number, found.points.astype(np.float32))
    return database


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
    with native_token(cancelled) as token:
        pycolmap.triangulate_points(model, database, folder, folder, True, options, False, token)
    least = min(views, MIN_VIEWS_OF_TRACK)
    for number in [number for number, point in model.points3D.items() if point.track.length() < least]:
        model.delete_point3D(number)


def _epipolar_errors(
    verified: Sequence[pairs.Pair],
    cameras: Sequence[Camera],
    features: Sequence[Features],
    database: pycolmap.Database,
) -> Float:
    """Sampson errors, in pixels of the searched photos, of all verified matches under the given cameras [n].

    Hartley and Zisserman, "Multiple View Geometry", 2nd edition, equation 11.9.
    """
    errors = [np.zeros(0)]
    for first, second in verified:
        matches = database.read_two_view_geometry(first + 1, second + 1).inlier_matches
        a, b = cameras[first], cameras[second]
        motion = b.viewmat @ np.linalg.inv(a.viewmat)
        x, y, z = motion[:3, 3]
        essential = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ motion[:3, :3]
        fundamental = np.linalg.inv(b.K).T @ essential @ np.linalg.inv(a.K)
        ones = np.ones((len(matches), 1))
        left = np.hstack([features[first].points[matches[:, 0]], ones])
        right = np.hstack([features[second].points[matches[:, 1]], ones])
        line, back = left @ fundamental.T, right @ fundamental
        across = (line[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1)
        errors.append(np.abs((right * line).sum(axis=1)) / np.sqrt(np.maximum(across, 1e-300)))
    return np.concatenate(errors)
