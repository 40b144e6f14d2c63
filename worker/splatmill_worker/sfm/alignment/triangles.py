"""First guesses of a similarity between two coloured clouds: triangles of equal shape and colours.

Random samples in the manner of RANSAC (Fischler and Bolles 1981): a triangle of neighbouring points of the scene, of
rare colours where possible, and those triangles of the scan that have the colours of its corners and the ratios of its
sides. Each determines a similarity. The points around the triangle tell which of these is right, so that only the
surroundings of one triangle have to be in both clouds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from splatmill_worker.scene import Float, Similarity
from splatmill_worker.sfm.alignment.cloud import ALIKE, Cloud

CANDIDATES = 110
"""Points of the scan that are tried for a corner, at most: their triples are compared at once."""

SHAPE = 0.1
"""Error of the ratio of two sides, as a logarithm, up to which triangles have the same shape."""

LONG = 6.0
"""Spacings of the scan that the longest side has at least, so that its length is known."""

REACH = 2.5
"""Spacings of the scan within which it has a point where the scene has one, around a triangle."""

FIRST, THEN = 10, 80
"""Points of the scene that all similarities are compared by, and those that the best of them are."""

BEST = 300
"""Similarities that are compared by THEN points."""

TRIED = 6000
"""Similarities of one triangle that are compared, at most."""


@dataclass(frozen=True)
class Palette:
    """How many points of a scan have the colour of each point of a scene, and which.

    counts: [n].
    tree: of the scan's colours.
    """

    counts: npt.NDArray[np.int64]
    tree: Any

    @staticmethod
    def of(scene: Cloud, scan: Cloud) -> Palette:
        """Of two clouds with colours."""
        from scipy.spatial import cKDTree

        tree = cKDTree(scan.colors.astype(np.float64))
        counts = tree.query_ball_point(scene.colors.astype(np.float64), ALIKE, p=np.inf, return_length=True)
        return Palette(np.asarray(counts, np.int64), tree)


def guesses(
    scene: Cloud, scan: Cloud, palette: Palette, random: np.random.Generator, most: int = 3
) -> list[Similarity]:
    """The best similarities from the scan to the scene by one random triangle, at most `most`; often none is right."""
    corners = _triangle(scene, palette, random)
    if corners is None:
        return []
    similarities = _same_shape(scene, scan, palette, corners, random)
    if similarities is None:
        return []
    rotations, scales, translations = similarities
    around = _around(scene, corners, random)
    for count, kept in ((FIRST, BEST), (THEN, most)):
        score = _agreement(scene, scan, around[:count], rotations, scales, translations)
        order = np.argsort(-score, kind="stable")[:kept]
        rotations, scales, translations = rotations[order], scales[order], translations[order]
    return [
        Similarity(rotation, float(scale), translation)
        for rotation, scale, translation in zip(rotations, scales, translations, strict=True)
    ]


def _triangle(scene: Cloud, palette: Palette, random: np.random.Generator) -> npt.NDArray[np.intp] | None:
    """Three points of the scene, far from a line, whose colours the scan has; rare ones are likelier."""
    known = np.flatnonzero(palette.counts > 0)
    if len(known) < 3:
        return None
    rarity = 1.0 / palette.counts[known]
    first = int(random.choice(known, p=rarity / rarity.sum()))
    size = scene.radius * float(np.exp(random.uniform(np.log(0.15), np.log(1.5))))
    distances = np.linalg.norm(scene.points[known] - scene.points[first], axis=1)
    others = known[(distances < size) & (distances > 0.3 * size)]
    if len(others) < 2:
        return None
    pairs = random.choice(others, (64, 2))
    a = scene.points[pairs[:, 0]] - scene.points[first]
    b = scene.points[pairs[:, 1]] - scene.points[first]
    longest = np.maximum(np.maximum(_length(a), _length(b)), _length(a - b))
    flatness = _length(np.cross(a, b)) / np.maximum(longest, 1e-300) ** 2
    rare = 1.0 / (1.0 + np.minimum(palette.counts[pairs], CANDIDATES)).prod(axis=1) ** 0.5
    value = np.where(flatness > 0.35, rare, 0.0)
    best = int(np.argmax(value))
    return None if not value[best] > 0.0 else np.array([first, *pairs[best]])


def _same_shape(
    scene: Cloud,
    scan: Cloud,
    palette: Palette,
    corners: npt.NDArray[np.intp],
    random: np.random.Generator,
) -> tuple[Float, Float, Float] | None:
    """Rotations, scales and translations to the triangle `corners`, from those of the scan that are like it."""
    rows = []
    for corner in corners:
        near = np.array(
            palette.tree.query_ball_point(scene.colors[corner].astype(np.float64), ALIKE, p=np.inf)
        )
        rows.append(random.choice(near, CANDIDATES, replace=False) if len(near) > CANDIDATES else near)
    a, b, c = (scan.points[each] for each in rows)
    p = scene.points[corners]
    ab, ac, bc = (
        np.log(np.maximum(_length(one[:, None] - other[None]), 1e-300))
        for one, other in ((a, b), (a, c), (b, c))
    )
    sides = np.log([np.linalg.norm(p[0] - p[1]), np.linalg.norm(p[0] - p[2]), np.linalg.norm(p[1] - p[2])])
    long = np.log(LONG * scan.spacing)
    wrong = np.abs(ac[:, None, :] - ab[:, :, None] - (sides[1] - sides[0]))
    wrong = np.fmax(wrong, np.abs(bc[None] - ab[:, :, None] - (sides[2] - sides[0])))
    fits = np.argwhere((wrong < SHAPE) & (ab[:, :, None] > long) & (ac[:, None, :] > long))
    if not len(fits):
        return None
    if len(fits) > TRIED:
        fits = fits[random.choice(len(fits), TRIED, replace=False)]
    i, j, k = fits.T
    own, theirs = _frames(p[None]), _frames(np.stack([a[i], b[j], c[k]], axis=1))
    rotations = own @ theirs.transpose(0, 2, 1)
    scales = np.exp(sides.mean() - (ab[i, j] + ac[i, k] + bc[j, k]) / 3.0)
    middles = (a[i] + b[j] + c[k]) / 3.0
    translations = p.mean(axis=0) - scales[:, None] * np.einsum("nij,nj->ni", rotations, middles)
    return rotations, scales, translations


def _frames(triangles: Float) -> Float:
    """Right-handed frames [n,3,3], in columns, of triangles [n,3,3]."""
    x = triangles[:, 1] - triangles[:, 0]
    z = np.cross(x, triangles[:, 2] - triangles[:, 0])
    x = x / np.maximum(_length(x), 1e-300)[:, None]
    z = z / np.maximum(_length(z), 1e-300)[:, None]
    return np.stack([x, np.cross(z, x), z], axis=2)


def _around(scene: Cloud, corners: npt.NDArray[np.intp], random: np.random.Generator) -> npt.NDArray[np.intp]:
    """Points of the scene around a triangle, the corners left out, in random order."""
    p = scene.points[corners]
    size = max(np.linalg.norm(p[0] - p[1]), np.linalg.norm(p[0] - p[2]))
    near = np.array(scene.tree.query_ball_point(p.mean(axis=0), 1.5 * size))
    rows: npt.NDArray[np.intp] = random.permutation(np.setdiff1d(near, corners))
    return rows


def _agreement(
    scene: Cloud,
    scan: Cloud,
    rows: npt.NDArray[np.intp],
    rotations: Float,
    scales: Float,
    translations: Float,
) -> Float:
    """Share of the points `rows` of the scene that the scan has in place and colour, for each similarity [n]."""
    if not len(rows):
        return np.zeros(len(scales))
    moved = np.einsum("nji,nmj->nmi", rotations, scene.points[rows][None] - translations[:, None])
    moved = (moved / scales[:, None, None]).reshape(-1, 3)
    _, near = scan.tree.query(moved, k=4, distance_upper_bound=REACH * scan.spacing)
    alike = scan.alike(near, np.tile(scene.colors[rows], (len(scales), 1))).any(axis=1)
    share: Float = alike.reshape(len(scales), -1).mean(axis=1)
    return share


def _length(vectors: Float) -> Float:
    length: Float = np.sqrt((vectors**2).sum(axis=-1))
    return length
