"""Clusters of a large view graph: parts of the photos that are mapped apart, each with some photos of its neighbours.

A part is grown from one photo, each time by the photo whose addition leaves the least weight between the part and the
rest (Karypis and Kumar, "A Fast and High Quality Multilevel Scheme for Partitioning Irregular Graphs", SIAM J. Sci.
Comput. 1998), and is improved by swaps with the rest (Kernighan and Lin, "An Efficient Heuristic Procedure for
Partitioning Graphs", Bell System Technical Journal 1970). All numbers are whole ones, so that every process finds the
same clusters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from heapq import heapify, heappop, heappush

from splatmill_worker.sfm.callbacks import stop_if

CLUSTER_PHOTOS = 250
"""Photos of a cluster, without those that it shares. From twice as many photos on, a capture has clusters (decisions:
clusters)."""

SHARED = 0.125
"""Photos of its neighbours that a cluster has too, over its own."""

STARTS = 16
"""Photos, or up to twice as many, from which a part is grown; the best one is kept."""

FRUITLESS = 100
"""Swaps in a row without a better cut, after which no more are tried."""

Graph = Sequence[Mapping[int, int]]
"""The partners of each photo, and the inliers of the pair."""


def number_of_clusters(count: int) -> int:
    """Into how many clusters `count` photos are divided; 0: they are mapped in one piece."""
    clusters = count // CLUSTER_PHOTOS
    return clusters if clusters > 1 else 0


def divide(
    count: int, inliers: Mapping[tuple[int, int], int], cancelled: Callable[[], bool]
) -> list[list[int]]:
    """The photos of each cluster, in ascending order.

    count: number of photos, enough for several clusters.
    inliers: of each pair of photos, by their indices.

    Raises Cancelled, when `cancelled` returns true.
    """
    graph: list[dict[int, int]] = [{} for _ in range(count)]
    for (first, second), weight in inliers.items():
        graph[first][second] = graph[second][first] = weight
    parts = _parts(graph, set(range(count)), number_of_clusters(count), cancelled)
    return [sorted(part | _neighbours(graph, part)) for part in parts]


def _parts(graph: Graph, photos: set[int], number: int, cancelled: Callable[[], bool]) -> list[set[int]]:
    """The photos in so many parts of equal size."""
    if number == 1:
        return [photos]
    first = number // 2
    size = len(photos) * first // number
    candidates = []
    for start in sorted(photos)[:: max(1, len(photos) // STARTS)]:
        stop_if(cancelled)
        candidates.append(_improved(graph, photos, _grown(graph, photos, start, size)))
    part = min(candidates, key=lambda each: _cut(graph, each, photos - each))
    return _parts(graph, part, first, cancelled) + _parts(graph, photos - part, number - first, cancelled)


class _Side:
    """The photos on one side of a cut that may change sides, and what the cut loses by each of them."""

    def __init__(self, graph: Graph, photos: set[int], others: set[int]) -> None:
        self._graph = graph
        sides = dict.fromkeys(photos, -1) | dict.fromkeys(others, 1)
        self.gains = {
            photo: sum(weight * sides.get(other, 0) for other, weight in graph[photo].items())
            for photo in photos
        }
        self._heap: list[tuple[int, int]] = []

    def consider_all(self) -> None:
        """Let `pop_best` choose among all photos. Without, it does among those whose gain has changed."""
        self._heap = [(-gain, photo) for photo, gain in self.gains.items()]
        heapify(self._heap)

    def pop_best(self, other_side: _Side | None = None) -> tuple[int, int] | None:
        """Take the photo from this side by which the cut loses the most; returns it and what the cut loses, None where
        there is no photo to choose."""
        while self._heap:
            gain, photo = heappop(self._heap)
            if self.gains.get(photo) == -gain:
                self.take(photo, other_side)
                return photo, -gain
        return None

    def take(self, photo: int, other_side: _Side | None = None) -> None:
        """Take a photo from this side. What other photos gain by following it rises, and on the other side it falls."""
        del self.gains[photo]
        for other, weight in self._graph[photo].items():
            self._change(other, 2 * weight)
            if other_side is not None:
                other_side._change(other, -2 * weight)

    def _change(self, photo: int, by: int) -> None:
        if photo in self.gains:
            self.gains[photo] += by
            heappush(self._heap, (-self.gains[photo], photo))


def _grown(graph: Graph, photos: set[int], start: int, size: int) -> set[int]:
    """So many of the photos, from the photo `start` on."""
    left = _Side(graph, photos, set())
    left.take(start)
    grown = {start}
    while len(grown) < size:
        best = left.pop_best()
        if best is None:  # nothing that is left is connected with the part
            best = min(left.gains), 0
            left.take(best[0])
        grown.add(best[0])
    return grown


def _improved(graph: Graph, photos: set[int], part: set[int]) -> set[int]:
    """The part after swaps with the rest, each time of the best photos and of each photo once, as long as such a row of
    swaps leaves less between the two."""
    while True:
        rest = photos - part
        ours, theirs = _Side(graph, part, rest), _Side(graph, rest, part)
        ours.consider_all()
        theirs.consider_all()
        swaps: list[tuple[int, int]] = []
        gained = best = kept = 0
        while len(swaps) < kept + FRUITLESS:
            leaves = ours.pop_best(theirs)
            joins = theirs.pop_best(ours)
            if leaves is None or joins is None:
                break
            swaps.append((leaves[0], joins[0]))
            gained += leaves[1] + joins[1]
            if gained > best:
                best, kept = gained, len(swaps)
        if not kept:
            return part
        part = (part - {photo for photo, _ in swaps[:kept]}) | {photo for _, photo in swaps[:kept]}


def _cut(graph: Graph, part: set[int], rest: set[int]) -> int:
    """The inliers of the pairs between two parts."""
    return sum(weight for photo in part for other, weight in graph[photo].items() if other in rest)


def _neighbours(graph: Graph, part: set[int]) -> set[int]:
    """The photos outside a part that have the most inliers with it: SHARED times its own, where there are as many."""
    weights: dict[int, int] = {}
    for photo in part:
        for other, weight in graph[photo].items():
            if other not in part:
                weights[other] = weights.get(other, 0) + weight
    nearest = sorted(weights, key=lambda photo: (-weights[photo], photo))
    return set(nearest[: round(SHARED * len(part))])
