"""Full matching of chosen pairs, and the two-view geometry that says which matches can be true."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from splatmill_worker.colmap import pycolmap
from splatmill_worker.sfm.cancellation import stop_if
from splatmill_worker.sfm.features import Features
from splatmill_worker.sfm.matching import Matcher, Matches
from splatmill_worker.sfm.pairs import Pair

MIN_INLIERS = 15  # COLMAP's floor for a pair to count
# A pair that needs more trials than this is one where chance matches prevail: it costs ten times as much as a
# good one and the mapper gains nothing from it.
MAX_TRIALS = 500
MAX_ERROR_SHARE = 4.0 / 1000.0  # of the longest side: COLMAP's 4 pixels at its usual size
Config = pycolmap.TwoViewGeometryConfiguration
TURNED_ONLY = (int(Config.PANORAMIC), int(Config.PLANAR_OR_PANORAMIC), int(Config.PLANAR))


@dataclass(frozen=True)
class Verified:
    """What matching a pair gave: matches, those that fit one geometry, and COLMAP's kind of geometry."""

    matches: int
    inliers: int
    config: int


def match_pairs(
    chosen: Iterable[Pair],
    features: Sequence[Features],
    ids: dict[int, int],
    database: pycolmap.Database,
    strongest: int,
    seed: int,
    pool: ThreadPoolExecutor,
    on_progress: Callable[[int, int], None],
    cancelled: Callable[[], bool],
) -> dict[Pair, Verified]:
    """Matches and verifies `chosen` pairs of photos and stores them; pairs stored before are only counted.

    `strongest`: features of a photo that are matched. COLMAP keeps whole octaves and gives up to twice what was
    asked for, which would make matching four times as slow.
    """
    cameras = {index: database.read_camera(database.read_image(ids[index]).camera_id) for index in ids}
    options = pycolmap.TwoViewGeometryOptions()
    options.min_num_inliers = MIN_INLIERS
    options.ransac.max_num_trials = MAX_TRIALS
    options.ransac.random_seed = seed
    longest = max((max(camera.width, camera.height) for camera in cameras.values()), default=1000)
    options.ransac.max_error = max(2.0, MAX_ERROR_SHARE * longest)
    matcher = Matcher(features, strongest)
    ordered = sorted(chosen)
    found: dict[Pair, Verified] = {}
    fresh: list[Pair] = []
    for pair in ordered:
        stored = _stored(database, ids, pair)
        if stored is None:
            fresh.append(pair)
        else:
            found[pair] = stored

    def work(pair: Pair) -> tuple[Matches, pycolmap.TwoViewGeometry | None]:
        if cancelled():
            return np.zeros((0, 2), np.uint32), None
        matches = matcher.match(*pair)
        if len(matches) < MIN_INLIERS:
            return matches, None
        first, second = pair
        return matches, pycolmap.estimate_two_view_geometry(
            cameras[first], features[first].points, cameras[second], features[second].points, matches, options
        )

    for done, (pair, (matches, geometry)) in enumerate(zip(fresh, pool.map(work, fresh), strict=True), 1):
        stop_if(cancelled)
        first, second = ids[pair[0]], ids[pair[1]]
        if not database.exists_matches(first, second):  # there if an earlier run was killed between the two
            database.write_matches(first, second, matches)
        if geometry is None:
            geometry = pycolmap.TwoViewGeometry()
        database.write_two_view_geometry(first, second, geometry)
        found[pair] = Verified(len(matches), len(geometry.inlier_matches), int(geometry.config))
        if done % 16 == 0 or done == len(fresh):
            on_progress(len(found), len(ordered))
    return found


def _stored(database: pycolmap.Database, ids: dict[int, int], pair: Pair) -> Verified | None:
    first, second = ids[pair[0]], ids[pair[1]]
    if not database.exists_two_view_geometry(first, second):
        return None
    geometry = database.read_two_view_geometry(first, second)
    matches = len(database.read_matches(first, second))
    return Verified(matches, len(geometry.inlier_matches), int(geometry.config))
