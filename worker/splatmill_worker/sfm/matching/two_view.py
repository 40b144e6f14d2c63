"""Matches of chosen pairs of photos, verified by two-view geometry, in COLMAP's database."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatmill_worker.colmap import pycolmap
from splatmill_worker.sfm.callbacks import stop_if
from splatmill_worker.sfm.matching.matcher import Matcher, Matches
from splatmill_worker.sfm.matching.pairs import Pair
from splatmill_worker.sfm.options import PANORAMA_SIDE
from splatmill_worker.sfm.sift import Features

MIN_INLIERS = 15
"""Inliers from which a pair counts as verified; COLMAP's default."""

MAX_RANSAC_TRIALS = 500
"""RANSAC trials for a pair, at most (decisions: MAX_RANSAC_TRIALS)."""

MAX_ERROR_SHARE = 4.0 / 1000.0
"""Largest epipolar error of an inlier, as a share of the longest side: COLMAP's 4 pixels for photos of 1000."""

MIN_MAX_ERROR = 2.0
"""Pixels: the largest epipolar error is never smaller than this, however small the photos are."""

STILL = 1.0
"""Pixels by which a match moves at most that stands still: features are as exact as that."""

MOVED = 0.02
"""Share of the longest side by which half of the other matches move at least where still ones are dropped. So far from
it, less than a thousandth of a scene's features stand still."""

_Configuration = pycolmap.TwoViewGeometryConfiguration
ROTATION_CONFIGURATIONS = (
    int(_Configuration.PANORAMIC),
    int(_Configuration.PLANAR_OR_PANORAMIC),
    int(_Configuration.PLANAR),
)
"""COLMAP's kinds of two-view geometry that a homography explains: a turning camera, or a flat scene."""


@dataclass(frozen=True)
class TwoView:
    """Outcome of matching one pair.

    matches: number of feature matches.
    inliers: number of them that fit the two-view geometry.
    configuration: COLMAP's kind of two-view geometry.
    """

    matches: int
    inliers: int
    configuration: int


def max_error(longest: int) -> float:
    """Largest epipolar error of an inlier, in pixels of photos whose longest side has `longest` pixels."""
    return max(MIN_MAX_ERROR, MAX_ERROR_SHARE * longest)


def without_still(
    matches: Matches, first: npt.NDArray[np.float64], second: npt.NDArray[np.float64], longest: int
) -> Matches:
    """The matches [m,2] without those that lie at one place of both photos, where most others moved.

    They are of a logo or a dashboard that was not masked. Few enough for no geometry of their own are kept: where a
    camera turns about a point, that point stays.

    first, second: positions [n,2] of the features of both photos in pixels.
    longest: side of the photos in pixels.
    """
    moved = np.linalg.norm(first[matches[:, 0]] - second[matches[:, 1]], axis=1)
    still = np.asarray(moved <= STILL)
    if still.sum() < MIN_INLIERS or still.all() or np.median(moved[~still]) < MOVED * longest:
        return matches
    kept: Matches = matches[~still]
    return kept


def match_pairs(
    chosen: Iterable[Pair],
    features: Sequence[Features],
    ids: dict[int, int],
    database: pycolmap.Database,
    seed: int,
    pool: ThreadPoolExecutor,
    on_progress: Callable[[int, int], None],
    cancelled: Callable[[], bool],
) -> dict[Pair, TwoView]:
    """Match and verify the `chosen` pairs of photos, and store the results in `database`.

    Pairs that the database has already are read, not matched again.

    ids: COLMAP's image id of each photo.
    """
    cameras = {index: database.read_camera(database.read_image(ids[index]).camera_id) for index in ids}
    options = pycolmap.TwoViewGeometryOptions()
    options.min_num_inliers = MIN_INLIERS
    options.ransac.max_num_trials = MAX_RANSAC_TRIALS
    options.ransac.random_seed = seed
    # Of the same size of pixels as other photos.
    sides = (
        max(each.width, each.height) / (PANORAMA_SIDE if each.is_spherical() else 1.0)
        for each in cameras.values()
    )
    longest = round(max(sides, default=1000))
    options.ransac.max_error = max_error(longest)
    matcher = Matcher(features)
    ordered = sorted(chosen)
    outcomes: dict[Pair, TwoView] = {}
    fresh: list[Pair] = []
    for pair in ordered:
        stored = _stored(database, ids, pair)
        if stored is None:
            fresh.append(pair)
        else:
            outcomes[pair] = stored

    def work(pair: Pair) -> tuple[Matches, pycolmap.TwoViewGeometry | None]:
        if cancelled():
            return np.zeros((0, 2), np.uint32), None
        first, second = pair
        matches = without_still(
            matcher.match(*pair), features[first].points, features[second].points, longest
        )
        if len(matches) < MIN_INLIERS:
            return matches, None
        return matches, pycolmap.estimate_two_view_geometry(
            cameras[first], features[first].points, cameras[second], features[second].points, matches, options
        )

    for pair, (matches, geometry) in zip(fresh, pool.map(work, fresh), strict=True):
        stop_if(cancelled)
        first, second = ids[pair[0]], ids[pair[1]]
        if not database.exists_matches(
            first, second
        ):  # they exist when a run was killed between the two writes
            database.write_matches(first, second, matches)
        if geometry is None:
            geometry = pycolmap.TwoViewGeometry()
        database.write_two_view_geometry(first, second, geometry)
        outcomes[pair] = TwoView(len(matches), len(geometry.inlier_matches), int(geometry.config))
        on_progress(len(outcomes), len(ordered))
    return outcomes


def _stored(database: pycolmap.Database, ids: dict[int, int], pair: Pair) -> TwoView | None:
    """The outcome of a pair that was matched before."""
    first, second = ids[pair[0]], ids[pair[1]]
    if not database.exists_two_view_geometry(first, second):
        return None
    geometry = database.read_two_view_geometry(first, second)
    matches = len(database.read_matches(first, second))
    return TwoView(matches, len(geometry.inlier_matches), int(geometry.config))
