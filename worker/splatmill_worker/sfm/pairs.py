"""Which pairs of photos are worth matching in full."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import combinations

import numpy as np
import numpy.typing as npt

from splatmill_worker.images.prepare import Usable
from splatmill_worker.sfm.cancellation import stop_if
from splatmill_worker.sfm.descriptor import similarities
from splatmill_worker.sfm.features import Features
from splatmill_worker.sfm.matching import Matcher

Pair = tuple[int, int]

EXHAUSTIVE_UP_TO = 12  # photos: 66 pairs cost less than choosing among them
LOOK_FEATURES = 256  # the largest features of a photo, for the quick look
LOOK_PARTNERS = 30  # candidates for the quick look in sets beyond LOOK_AT_ALL
LOOK_AT_ALL = 60  # photos: up to here every pair gets a quick look
MIN_LOOK = 4  # matches in the quick look: fewer are chance
SURE_PARTNERS = 3  # the best of each photo are matched however few their matches
NUMBERED = re.compile(r"(.*?)(\d+)\.[^.]+$")
MIN_BURST = 5  # photos
BURST_STEPS = (1, 2)
EARTH_RADIUS = 6_371_000.0  # metres


def exhaustive(count: int) -> list[Pair]:
    """All pairs of `count` photos."""
    return list(combinations(range(count), 2))


def sequential(order: Sequence[int], steps: Iterable[int] = (1, 2, 3, 4, 6, 8)) -> set[Pair]:
    """Each photo with those `steps` later in time."""
    return {
        _pair(order[at], order[at + step]) for step in steps for at in range(len(order) - step) if step > 0
    }


def sequences(photos: Sequence[Usable]) -> list[list[int]]:
    """Runs of photos that follow each other in time: the frames of each video, in order."""
    videos: dict[str, list[int]] = {}
    for index, photo in enumerate(photos):
        if photo.sequence is not None:
            videos.setdefault(photo.sequence, []).append(index)
    return list(videos.values())


def bursts(photos: Sequence[Usable]) -> list[list[int]]:
    """Runs of numbered photos (a common start of the name, then a number), by number.

    Photos with consecutive numbers were mostly taken one after another, so their neighbours are worth a match
    whatever a quick look says.
    """
    runs: dict[str, list[tuple[int, int]]] = {}
    for index, photo in enumerate(photos):
        found = NUMBERED.match(photo.name) if photo.sequence is None else None
        if found is not None:
            runs.setdefault(found[1], []).append((int(found[2]), index))
    return [[index for _, index in sorted(run)] for run in runs.values() if len(run) >= MIN_BURST]


def positions(photos: Sequence[Usable]) -> npt.NDArray[np.float64]:
    """East, north and up in metres [n,3] around the mean place; NaN for photos without GPS."""
    places = np.array(
        [(p.exif.latitude or math.nan, p.exif.longitude or math.nan) for p in photos], np.float64
    )
    places = np.radians(places.reshape(-1, 2))
    up = np.array([p.exif.altitude if p.exif.altitude is not None else 0.0 for p in photos])
    if np.isnan(places).all():
        return np.full((len(photos), 3), math.nan)
    middle = np.nanmean(places, axis=0)
    # A place's longitude wraps at 180 degrees.
    longitude = (places[:, 1] - middle[1] + math.pi) % (2.0 * math.pi) - math.pi
    east = longitude * math.cos(middle[0]) * EARTH_RADIUS
    north = (places[:, 0] - middle[0]) * EARTH_RADIUS
    return np.stack([east, north, up], axis=1)


def spatial(places: npt.NDArray[np.float64], neighbours: int) -> set[Pair]:
    """Each photo that has a place with its nearest `neighbours`; heights are too noisy to count."""
    known = np.flatnonzero(np.isfinite(places).all(axis=1))
    flat = places[known, :2]
    chosen: set[Pair] = set()
    for row, index in enumerate(known):
        distance = np.linalg.norm(flat - flat[row], axis=1)
        distance[row] = math.inf
        for other in np.argsort(distance, kind="stable")[: min(neighbours, len(known) - 1)]:
            chosen.add(_pair(int(index), int(known[other])))
    return chosen


def quick_look(
    features: Sequence[Features],
    likely: set[Pair],
    pool: ThreadPoolExecutor,
    on_progress: Callable[[int, int], None],
    cancelled: Callable[[], bool],
) -> dict[Pair, int]:
    """The number of matches among the largest features, for all pairs or (in large sets) for the likeliest.

    Candidates of large sets come from a small descriptor of each whole photo, so that the time grows with the
    number of photos and not with its square; `likely` pairs are looked at in any case.
    """
    count = len(features)
    candidates = set(exhaustive(count)) if count <= LOOK_AT_ALL else _alike(features, LOOK_PARTNERS) | likely
    matcher = Matcher(features, strongest=LOOK_FEATURES)
    ordered = sorted(candidates)
    scores: dict[Pair, int] = {}
    for pair, score in zip(ordered, pool.map(lambda pair: len(matcher.match(*pair)), ordered), strict=True):
        scores[pair] = score
        if len(scores) % 64 == 0:
            stop_if(cancelled)
            on_progress(len(scores), len(ordered))
    return scores


def best_partners(scores: dict[Pair, int], count: int, partners: int) -> set[Pair]:
    """For each photo its `partners` best pairs by score; the first few of them however low they score."""
    chosen: set[Pair] = set()
    for ranked in _ranked(scores, count):
        for rank, pair in enumerate(ranked[:partners]):
            if rank < SURE_PARTNERS or scores[pair] >= MIN_LOOK:
                chosen.add(pair)
    return chosen


def likeliest(scores: dict[Pair, int], count: int, photos: Iterable[int], partners: int) -> set[Pair]:
    """The `partners` best pairs by score of each of `photos` (of `count`)."""
    ranked = _ranked(scores, count)
    return {pair for photo in photos for pair in ranked[photo][:partners]}


def components(count: int, edges: Iterable[Pair]) -> list[list[int]]:
    """The connected parts of the view graph, the largest first."""
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


def bridges(parts: list[list[int]], scores: dict[Pair, int], tried: set[Pair], per_photo: int) -> set[Pair]:
    """Untried pairs between different parts, the `per_photo` likeliest of each photo outside the largest part."""
    part_of = {index: number for number, part in enumerate(parts) for index in part}
    chosen: set[Pair] = set()
    for part in parts[1:]:
        for index in part:
            others = [_pair(index, other) for other in part_of if part_of[other] != part_of[index]]
            fresh = [pair for pair in others if pair not in tried]
            fresh.sort(key=lambda pair: (-scores.get(pair, 0), pair))
            chosen.update(fresh[:per_photo])
    return chosen


def _ranked(scores: dict[Pair, int], count: int) -> list[list[Pair]]:
    """The pairs of each photo, the best by score first."""
    by_photo: list[list[Pair]] = [[] for _ in range(count)]
    for pair in sorted(scores, key=lambda pair: (-scores[pair], pair)):
        for index in pair:
            by_photo[index].append(pair)
    return by_photo


def _alike(features: Sequence[Features], partners: int) -> set[Pair]:
    likeness = similarities(features)
    np.fill_diagonal(likeness, -math.inf)
    chosen: set[Pair] = set()
    for index, row in enumerate(likeness):
        for other in np.argpartition(-row, min(partners, len(row) - 1))[:partners]:
            if other != index:
                chosen.add(_pair(index, int(other)))
    return chosen


def _pair(first: int, second: int) -> Pair:
    return (first, second) if first < second else (second, first)
