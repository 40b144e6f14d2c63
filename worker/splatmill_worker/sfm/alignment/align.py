"""Finds the similarity from the coordinates of a scan to those of a scene by the points of both."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from splatmill_worker.scene import Float, Similarity
from splatmill_worker.sfm.alignment import icp, triangles
from splatmill_worker.sfm.alignment.cells import spread
from splatmill_worker.sfm.alignment.cloud import Cloud, Levels, degenerate
from splatmill_worker.sfm.callbacks import OnProgress, stop_if

SCENE_POINTS = 3_000
"""Points of the scene that are compared."""

FIRST_POINTS = 1_000
"""Points of the scene that a first guess is refined with. Most guesses are wrong, and have a low score after it
(decisions: FIRST_POINTS)."""

SPARSE, DENSE = (4_000, 20_000), 100_000
"""Points of the scan that the first guess is searched with, in turns: of a scan that has much more than the scene, many
are needed. And those that it is refined with."""

FAR = 1e4
"""Median distances from the median, behind which a point of a scan is taken for a fault of the scanner."""

READ = 300_000
"""Points of a scan from which these are chosen."""

NEAR = 0.02
"""Distance, in radii of the scene, within which a point of the scene lies on the scan. Points of structure from motion
are sure to a pixel or two of some hundred."""

ROUNDS = 400
"""Triangles that are tried, at most."""

VOTES, EVIDENT = 3, 0.15
"""Triangles that lead to the same similarity, and the share of the points of the scene in place and colour, above that
by chance, with which the search ends before all are tried."""

MANY_VOTES = 6
"""Triangles that lead to the same similarity, with which the search ends whatever the share is: a scan may have a tenth
of the scene."""

MIRRORED = 1.1
"""Ratio of the shares of a mirror image and of the scan from which the scan is mirrored; 1 for a plane."""

KEPT = 20
"""Similarities that votes are counted for."""

SAME = 0.1
"""Median distance between the points as two similarities place them, in their radii, up to which these are the same."""


@dataclass(frozen=True)
class Aligned:
    """The similarity of a scan to a scene.

    similarity: from the scan's coordinates to those of the scene.
    share: of the points of the scene that lie on the scan.
    residual: median distance of these from the scan's surfaces, in units of the scan.
    """

    similarity: Similarity
    share: float
    residual: float


@dataclass(frozen=True, eq=False)
class _Place:
    """A similarity that triangles led to.

    score: share of the points of the scene that the scan has under it, above chance.
    votes: number of triangles.
    held: points of each thinned scan that the scene has under it [n,3].
    """

    score: float
    votes: int
    similarity: Similarity
    held: tuple[Float, ...]


@dataclass(frozen=True)
class Unaligned:
    """No similarity was found; `reason` is the end of a sentence."""

    reason: str


def align(
    points: Float,
    colors: npt.NDArray[np.uint8],
    scene_points: Float,
    scene_colors: npt.NDArray[np.uint8],
    *,
    seed: int = 0,
    on_progress: OnProgress = lambda stage, done, total, note: None,
    cancelled: Callable[[], bool] = lambda: False,
) -> Aligned | Unaligned:
    """Return the similarity that brings the points of a scan onto those of a scene, or why there is none.

    It is the best that was found: whether it is right, the photos have to tell.

    points: of the scan [n,3], in any unit, rotated and shifted; coordinates of millions lose nothing.
    colors: RGB of these [n,3].
    scene_points, scene_colors: of the scene [m,3].
    on_progress: called with the stage "alignment" and numbers of triangles; most scans need few of the total.

    Raises ImportError without scipy, and Cancelled.
    """
    random = np.random.default_rng(seed)
    if (reason := degenerate(scene_points)) is not None:
        return Unaligned(f"of the cloud of the photos, {reason}")
    # Near the origin, so that squares lose no digits.
    middle, about = np.median(points, axis=0), np.median(scene_points, axis=0)
    some = random.choice(len(points), READ, replace=False) if len(points) > READ else np.arange(len(points))
    distances = np.abs(points[some] - middle).max(axis=1)
    some = some[distances <= FAR * max(float(np.median(distances)), np.finfo(np.float64).tiny)]
    dense = spread(points[some] - middle, DENSE)
    dense = some[dense]
    if (reason := degenerate(points[dense] - middle)) is not None:
        return Unaligned(f"of the file, {reason}")
    scan = Cloud.of(points[dense] - middle, colors[dense])
    rows = spread(scene_points - about, SCENE_POINTS)
    scene = Cloud.of(scene_points[rows] - about, scene_colors[rows])
    if not (scan.radius > 0.0 and scene.radius > 0.0):
        return Unaligned("more than half of the points lie at one place")
    guess = _search(scene, scan, random, on_progress, cancelled)
    if guess is None:
        return Unaligned("no part of it has the shape and the colours of a part of the scene")
    normals = icp.normals_of(scan)
    best = _finished(scene, scan, guess, normals)
    mirrored = _finished(scene, *_mirrored(scene, scan, best.similarity), normals=None)
    if mirrored.share > max(EVIDENT, MIRRORED * best.share):
        return Unaligned(
            f"its mirror image fits better, with {100 * mirrored.share:.0f} % of the points of the photos on it in "
            f"place of {100 * best.share:.0f} %. Exchange the sign of one axis"
        )
    outward = Similarity(np.eye(3), 1.0, about)
    return replace(best, similarity=Similarity(np.eye(3), 1.0, -middle).then(best.similarity).then(outward))


def _mirrored(scene: Cloud, scan: Cloud, similarity: Similarity) -> tuple[Cloud, Similarity]:
    """The mirror image of a scan, in the plane nearest to its points that the scene has, and its similarity: what the
    scene has in that plane stays where it is."""
    partners = icp.pairs(scene, scan, similarity, _near(scene, scan, similarity)).partners
    plane = scan.points[partners] if len(partners) >= icp.FEWEST else scan.points
    middle = np.median(plane, axis=0)
    normal = np.linalg.svd(plane - middle, full_matrices=False)[2][2]
    points = scan.points - 2.0 * ((scan.points - middle) @ normal)[:, None] * normal
    return Cloud.of(points, scan.colors), similarity


def _finished(scene: Cloud, scan: Cloud, first: Similarity, normals: Float | None) -> Aligned:
    """The similarity refined with all points of the scan, and how well it fits. normals: of the scan, or None."""
    normals = icp.normals_of(scan) if normals is None else normals
    limit = max(3.0 * NEAR * scene.radius, 3.0 * scan.spacing * first.scale)
    nearer = icp.refined(scene, scan, first, limit, 10)
    best = icp.refined(scene, scan, nearer, limit, 20, normals)
    matches = icp.pairs(scene, scan, best, _near(scene, scan, best))
    if not len(matches.rows):
        return Aligned(best, 0.0, float("inf"))
    apart = scene.points[matches.rows] - best.points(scan.points[matches.partners])
    off = np.abs((apart * (normals[matches.partners] @ best.rotation.T)).sum(axis=1)) / best.scale
    return Aligned(best, len(matches.rows) / len(scene.points), float(np.median(off)))


def _near(scene: Cloud, scan: Cloud, similarity: Similarity) -> float:
    """Distance within which a point of the scene lies on the scan, in units of the scene."""
    return max(NEAR * scene.radius, 1.5 * scan.spacing * similarity.scale)


def _search(
    scene: Cloud,
    scan: Cloud,
    random: np.random.Generator,
    on_progress: OnProgress,
    cancelled: Callable[[], bool],
) -> Similarity | None:
    """The similarity that triangles of equal colours lead to, again and again; that with the most points otherwise."""
    clouds = [scan.thinned(count) for count in SPARSE]
    palettes = [triangles.Palette.of(scene, each) for each in clouds]
    exchanged = scene.colors[random.permutation(len(scene.colors))]
    few = scene.thinned(FIRST_POINTS)
    best: list[_Place] = []
    for count in range(ROUNDS):
        stop_if(cancelled)
        on_progress("alignment", count, ROUNDS, "places of the scan tried, at most")
        reached: list[tuple[float, Similarity]] = []
        turn = count % len(clouds)
        scan, palette = clouds[turn], palettes[turn]
        for guess in triangles.guesses(scene, scan, palette, random):
            moved = icp.refined(few, scan, guess, 4.0 * scan.spacing * guess.scale, 8)
            reached.append((_score(scene, exchanged, scan, moved), moved))
        if not reached:
            continue
        score, similarity = max(reached, key=lambda each: each[0])
        if score > 0.5 * max((place.score for place in best), default=0.0):
            limit = 2.0 * _near(scene, scan, similarity)
            similarity = icp.refined(scene, scan, similarity, limit, 12)
            score = _score(scene, exchanged, scan, similarity)
        same = [place for place in best if _same(place.similarity, similarity, place.held[turn])]
        best = [place for place in best if place not in same]
        held = tuple(_held(scene, cloud, similarity) for cloud in clouds)
        top = max([_Place(score, 1, similarity, held), *same], key=lambda place: place.score)
        best.append(replace(top, votes=1 + sum(place.votes for place in same)))
        best.sort(key=lambda place: -place.score)
        best = best[:KEPT]
        votes, score = best[0].votes, best[0].score
        if votes >= MANY_VOTES or (votes >= VOTES and score > EVIDENT):
            break
    return best[0].similarity if best and best[0].score > 0.0 else None


def _score(scene: Cloud, exchanged: Levels, scan: Cloud, similarity: Similarity) -> float:
    """Share of the points of the scene that the scan has, less that with the colours `exchanged` [n,3]."""
    _, near = icp.nearest(scene, scan, similarity, _near(scene, scan, similarity))
    own, other = (int(scan.alike(near, colors).any(axis=1).sum()) for colors in (scene.colors, exchanged))
    return (own - other) / len(scene.points)


def _held(scene: Cloud, scan: Cloud, similarity: Similarity) -> Float:
    """The points of the scan [n,3] that the scene has under a similarity."""
    held: Float = scan.points[icp.pairs(scene, scan, similarity, _near(scene, scan, similarity)).partners]
    return held


def _same(one: Similarity, other: Similarity, held: Float) -> bool:
    """Whether two similarities place the points `held` [n,3] of the scan, which the scene has, at the same places."""
    if not len(held):
        return False
    first, second = one.points(held), other.points(held)
    radius = float(np.median(np.linalg.norm(first - np.median(first, axis=0), axis=1)))
    return bool(np.median(np.linalg.norm(first - second, axis=1)) < SAME * radius)
