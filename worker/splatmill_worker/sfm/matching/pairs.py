"""The choice of pairs of photos to match, and the view graph of the pairs that were verified."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import combinations

import numpy as np
import numpy.typing as npt

from splatmill_worker.images.prepare import UsablePhoto
from splatmill_worker.sfm.callbacks import stop_if
from splatmill_worker.sfm.matching.matcher import Matcher
from splatmill_worker.sfm.matching.vlad import similarities
from splatmill_worker.sfm.sift import Features

Pair = tuple[int, int]
"""Indices of two photos, the smaller one first."""

EXHAUSTIVE_UP_TO = 12
"""Photos up to which all pairs are matched: 66 pairs cost less than choosing among them."""

PREEMPTIVE_FEATURES = 256
"""Features of a photo that are compared in preemptive matching."""

PREEMPTIVE_EXHAUSTIVE_UP_TO = 60
"""Photos up to which preemptive matching compares all pairs."""

PREEMPTIVE_PARTNERS = 30
"""Candidates per photo for preemptive matching in larger sets, by VLAD similarity."""

MIN_PREEMPTIVE_MATCHES = 4
"""Preemptive matches below which a pair is not matched in full: so few also occur by chance."""

CERTAIN_PARTNERS = 3
"""Pairs of each photo with the most preemptive matches that are matched in full even below MIN_PREEMPTIVE_MATCHES."""

SEQUENCE_STEPS = (1, 2, 3, 4, 6, 8)
"""Distances, in frames of a video or positions in an order, of two photos that are matched."""

NUMBERED_NAME = re.compile(r"(.*?)(\d+)\.[^.]+$")
"""A file name that ends in a number, split into what precedes the number and the number."""

MIN_NUMBERED_RUN = 5
"""Least number of photos with the same name before the number whose numbers are taken as the order of shooting."""

NUMBERED_STEPS = (1, 2)
"""Distances, in positions of that order, of two photos that are matched."""

EARTH_RADIUS = 6_371_000.0
"""Metres, the mean radius."""


def exhaustive(count: int) -> list[Pair]:
    """All pairs of `count` photos."""
    return list(combinations(range(count), 2))


def sequential(order: Sequence[int], steps: Iterable[int] = SEQUENCE_STEPS) -> set[Pair]:
    """Pairs of photos whose positions in `order` differ by one of `steps`."""
    return {
        _pair(order[at], order[at + step]) for step in steps for at in range(len(order) - step) if step > 0
    }


def video_sequences(photos: Sequence[UsablePhoto]) -> list[list[int]]:
    """The frames of each video, in order."""
    videos: dict[str, list[int]] = {}
    for index, photo in enumerate(photos):
        if photo.sequence is not None:
            videos.setdefault(photo.sequence, []).append(index)
    return list(videos.values())


def numbered_runs(photos: Sequence[UsablePhoto]) -> list[list[int]]:
    """Photos whose names differ only in their final number, ordered by that number.

    Most photos with consecutive numbers were taken one after the other, so neighbours are matched in full even where
    preemptive matching finds little.
    """
    runs: dict[str, list[tuple[int, int]]] = {}
    for index, photo in enumerate(photos):
        match = NUMBERED_NAME.match(photo.name) if photo.sequence is None else None
        if match is not None:
            runs.setdefault(match[1], []).append((int(match[2]), index))
    return [[index for _, index in sorted(run)] for run in runs.values() if len(run) >= MIN_NUMBERED_RUN]


def gps_positions(photos: Sequence[UsablePhoto]) -> npt.NDArray[np.float64]:
    """Positions [n,3] by GPS: metres east and north of the mean position, and altitude in metres above sea level.

    East and north are NaN for photos without GPS; the altitude is 0 where it is unknown.
    """
    # None becomes NaN; 0 is a place on the equator or on the prime meridian.
    degrees = np.array([(p.exif.latitude, p.exif.longitude) for p in photos], np.float64)
    radians = np.radians(degrees.reshape(-1, 2))
    up = np.array([p.exif.altitude if p.exif.altitude is not None else 0.0 for p in photos])
    if np.isnan(radians).all():
        return np.full((len(photos), 3), math.nan)
    middle = np.nanmean(radians, axis=0)
    # Differences of longitude wrap at 180 degrees.
    longitude = (radians[:, 1] - middle[1] + math.pi) % (2.0 * math.pi) - math.pi
    east = longitude * math.cos(middle[0]) * EARTH_RADIUS
    north = (radians[:, 0] - middle[0]) * EARTH_RADIUS
    return np.stack([east, north, up], axis=1)


def spatial(positions: npt.NDArray[np.float64], neighbours: int) -> set[Pair]:
    """Each photo with the `neighbours` photos nearest to it by GPS.

    positions [n,3] are those of `gps_positions`. Heights are left out: GPS measures them too coarsely.
    """
    known = np.flatnonzero(np.isfinite(positions).all(axis=1))
    flat = positions[known, :2]
    chosen: set[Pair] = set()
    for row, index in enumerate(known):
        distance = np.linalg.norm(flat - flat[row], axis=1)
        distance[row] = math.inf
        for other in np.argsort(distance, kind="stable")[: min(neighbours, len(known) - 1)]:
            chosen.add(_pair(int(index), int(known[other])))
    return chosen


def preemptive_matches(
    features: Sequence[Features],
    likely: set[Pair],
    pool: ThreadPoolExecutor,
    on_progress: Callable[[int, int], None],
    cancelled: Callable[[], bool],
) -> dict[Pair, int]:
    """Number of matches among the features with the largest scale, for each candidate pair.

    Candidates are all pairs of small sets. In larger sets they are the `likely` pairs and those with the most similar
    VLAD descriptors, so that the time grows with the number of photos and not with its square.

    Wu, "Towards Linear-time Incremental Structure from Motion", 3DV 2013, section 3.
    """
    count = len(features)
    if count <= PREEMPTIVE_EXHAUSTIVE_UP_TO:
        candidates = set(exhaustive(count))
    else:
        on_progress(0, count * PREEMPTIVE_PARTNERS)
        candidates = _most_similar(features, PREEMPTIVE_PARTNERS) | likely
    return matches_of_largest(candidates, features, pool, on_progress, cancelled)


def matches_of_largest(
    candidates: Iterable[Pair],
    features: Sequence[Features],
    pool: ThreadPoolExecutor,
    on_progress: Callable[[int, int], None],
    cancelled: Callable[[], bool],
) -> dict[Pair, int]:
    """Number of matches among the PREEMPTIVE_FEATURES features with the largest scale, for each candidate pair."""
    matcher = Matcher(features, max_features=PREEMPTIVE_FEATURES)
    ordered = sorted(candidates)
    scores: dict[Pair, int] = {}
    for pair, score in zip(ordered, pool.map(lambda pair: len(matcher.match(*pair)), ordered), strict=True):
        scores[pair] = score
        if len(scores) % 64 == 0:
            stop_if(cancelled)
            on_progress(len(scores), len(ordered))
    return scores


def best_partners(scores: dict[Pair, int], count: int, partners: int) -> set[Pair]:
    """The `partners` pairs of each photo with the most preemptive matches.

    Pairs with fewer than MIN_PREEMPTIVE_MATCHES are left out, except for the first CERTAIN_PARTNERS of a photo.
    """
    chosen: set[Pair] = set()
    for ranked in _ranked(scores, count):
        for rank, pair in enumerate(ranked[:partners]):
            if rank < CERTAIN_PARTNERS or scores[pair] >= MIN_PREEMPTIVE_MATCHES:
                chosen.add(pair)
    return chosen


def best_pairs_of(photos: Iterable[int], scores: dict[Pair, int], count: int, partners: int) -> set[Pair]:
    """The `partners` pairs with the most preemptive matches of each of `photos`, which are some of `count`."""
    ranked = _ranked(scores, count)
    return {pair for photo in photos for pair in ranked[photo][:partners]}


def connected_components(count: int, edges: Iterable[Pair]) -> list[list[int]]:
    """The connected components of the view graph with `count` photos, the largest first."""
    parent = list(range(count))

    def root(node: int) -> int:
        while parent[node] != node:
            parent[node] = parent[parent[node]]
            node = parent[node]
        return node

    for first, second in edges:
        parent[root(first)] = root(second)
    parts: dict[int, list[int]] = {}
    for node in range(count):
        parts.setdefault(root(node), []).append(node)
    return sorted(parts.values(), key=lambda part: (-len(part), part))


def connecting_pairs(
    components: list[list[int]], scores: dict[Pair, int], tried: set[Pair], per_photo: int
) -> set[Pair]:
    """Pairs between different components that were not tried yet.

    For each photo outside the first component, the `per_photo` pairs with the most preemptive matches.
    """
    component_of = {index: number for number, part in enumerate(components) for index in part}
    chosen: set[Pair] = set()
    for part in components[1:]:
        for index in part:
            others = [
                _pair(index, other) for other in component_of if component_of[other] != component_of[index]
            ]
            fresh = [pair for pair in others if pair not in tried]
            fresh.sort(key=lambda pair: (-scores.get(pair, 0), pair))
            chosen.update(fresh[:per_photo])
    return chosen


def _ranked(scores: dict[Pair, int], count: int) -> list[list[Pair]]:
    """The pairs of each photo, those with the most matches first."""
    by_photo: list[list[Pair]] = [[] for _ in range(count)]
    for pair in sorted(scores, key=lambda pair: (-scores[pair], pair)):
        for index in pair:
            by_photo[index].append(pair)
    return by_photo


def _most_similar(features: Sequence[Features], partners: int) -> set[Pair]:
    """Each photo with the `partners` photos that have the most similar VLAD descriptors."""
    similarity = similarities(features)
    np.fill_diagonal(similarity, -math.inf)
    chosen: set[Pair] = set()
    for index, row in enumerate(similarity):
        for other in np.argpartition(-row, min(partners, len(row) - 1))[:partners]:
            if other != index:
                chosen.add(_pair(index, int(other)))
    return chosen


def _pair(first: int, second: int) -> Pair:
    return (first, second) if first < second else (second, first)
