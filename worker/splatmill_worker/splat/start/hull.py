"""The visual hull of an object: the space that no photo shows to be transparent (Laurentini, PAMI 1994).

It is carved from a cube of voxels, coarse to fine: only voxels that the outline of the object crosses in some photo are
divided (Szeliski, CVGIP 1993). A photo rejects a voxel when all of the voxel falls on transparent pixels, so that parts
thinner than a voxel survive, and says nothing about a voxel that it does not show whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from splatmill_worker.scene import MIN_DEPTH, WRONG_OUTLINES, Camera, looked_at
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.start.frusta import RANDOM_GAUSSIANS
from splatmill_worker.splat.start.points import ENOUGH_POINTS, from_points
from splatmill_worker.splat.views import Target

Real = npt.NDArray[np.float32]
Float = npt.NDArray[np.float64]
Index = npt.NDArray[np.int32]
Flags = npt.NDArray[np.bool_]
Count = npt.NDArray[np.int16]
Pixels = npt.NDArray[np.uint8]

CLEAR = 0.02
"""Alpha (0 to 1) below which a pixel counts as transparent: programs that cut out objects leave faint haze."""

LEAST_VIEWS = 3
"""Photos that must show a voxel: two outlines leave it open in the third direction."""

SUPPORT = 0.5
"""Share of the photos that must show a voxel, relative to the one that most photos show. The cones of a few
neighbouring photos meet again far behind the object, where no photo of another side contradicts them."""

COARSE = 6
"""Divisions of the cube after which it is judged whether outlines bound the object: 64 voxels a side."""

MOST_OPEN = 0.25
"""Share of the hull's coarse surface that the limits of the photos may make in place of outlines."""

PIXELS = 1.5
"""Least size of a voxel, in pixels of the photos: their outlines resolve no smaller one."""

MOST_PAIRS = 300_000_000
"""Pairs of a voxel and a photo that are held at once, a byte each."""

INNER = 0.8
"""Share of the points within the hull: an object with hollows lies deep in it (decisions: hull-start)."""

MOST_PHOTOS = 300
"""Photos, evenly chosen, whose outlines carve, at most."""

COLOR_PHOTOS = 32
"""Photos, evenly chosen, from which a point gets its colour; more hardly change the mean."""

HIDDEN = 1e-3
"""Weight of a photo in the colour of a point that it shows behind others."""

AT_FIRST = 1 / 16
"""Share of a hull's points that become Gaussians, where that is more than RANDOM_GAUSSIANS: training adds others where
the photos ask for them."""


class Hull(NamedTuple):
    """Points of a visual hull.

    points: places on the surface and within, in random order, float64 [n, 3].
    colors: mean colour of the photos that show them, uint8 [n, 3].
    size: side of a voxel, in units of the world.
    """

    points: Float
    colors: Pixels
    size: float

    def gaussians(self, count: int, points: Float, colors: Pixels) -> Gaussians:
        """A Gaussian on each of `points` [m, 3] and then of `count` points of the hull, as wide as they are apart."""
        return from_points(
            torch.from_numpy(np.concatenate([points, self.points[:count]])),
            torch.from_numpy(np.concatenate([colors, self.colors[:count]])),
        )


class _Inner(NamedTuple):
    """Voxels within a hull: their lowest corners [n, 3] and their sides [n]."""

    corners: Real
    sizes: Float

    def sample(self, count: int, random: np.random.Generator) -> Real:
        """Random places [count, 3], even over the volume; none where there is no voxel."""
        if not len(self.sizes):
            return np.zeros((0, 3), np.float32)
        volumes = self.sizes**3
        chosen = random.choice(len(volumes), count, p=volumes / volumes.sum())
        places = self.corners[chosen] + random.random((count, 3)) * self.sizes[chosen, None]
        return places.astype(np.float32)


class NoHull(NamedTuple):
    """Why outlines bound no object, a sentence."""

    reason: str


class _Silhouette(NamedTuple):
    """One photo: its camera, and the number of pixels above and left of each corner that may show the object."""

    camera: Camera
    sums: npt.NDArray[np.int32]

    @staticmethod
    def of(target: Target) -> _Silhouette:
        """Pixels that a mask hides may show anything."""
        assert target.alpha is not None
        shown = target.alpha.numpy() >= CLEAR * 255.0
        if target.mask is not None:
            shown |= ~target.mask.numpy()
        sums = np.zeros((shown.shape[0] + 1, shown.shape[1] + 1), np.int32)
        np.cumsum(np.cumsum(shown, axis=0, dtype=np.int32), axis=1, out=sums[1:, 1:])
        return _Silhouette(target.camera, sums)


class _Votes(NamedTuple):
    """What the photos say about n voxels.

    shown: number of photos that show the centre of the voxel [n].
    met: number of photos that show some of it [n].
    outside: number of photos in which all of it is transparent [n].
    crossed: number of photos in which the outline crosses it, or may cross it [n].
    certain_shown, certain_outside: numbers of those among them that say the same about every part of the voxel [n].
    open: the other photos, which are asked again about the parts, bool [photos, n].
    """

    shown: Count
    met: Count
    outside: Count
    crossed: Count
    certain_shown: Count
    certain_outside: Count
    open: Flags

    @property
    def wrong(self) -> Count:
        """Number of photos that may be wrong about each voxel [n]."""
        wrong: Count = (WRONG_OUTLINES * self.met).astype(np.int16)
        return wrong

    def parts(self, rows: Flags, count: int) -> _Votes:
        """What is certain about `count` parts of each of the voxels `rows` [n], part by part."""
        shown, outside = (
            certain[rows].repeat(count) for certain in (self.certain_shown, self.certain_outside)
        )
        return _Votes(
            shown, shown, outside, np.zeros_like(shown), shown, outside, self.open[:, rows].repeat(count, 1)
        )


def visual_hull(targets: Sequence[Target], most: int) -> Hull | NoHull:
    """Points in the visual hull of what the transparent photos among `targets` show, at most `most`.

    Opaque photos say nothing, and neither do those that are transparent everywhere.
    """
    used = [target for target in targets if target.alpha is not None and bool(target.alpha.any())]
    used = used[:: -(-len(used) // MOST_PHOTOS) or 1]
    if len(used) < LEAST_VIEWS:
        return NoHull(
            f"{len(used)} photos have transparent and opaque parts; outlines bound an object from {LEAST_VIEWS} photos "
            "on."
        )
    carved = _carved([_Silhouette.of(target) for target in used], round((1.0 - INNER) * most))
    if isinstance(carved, NoHull):
        return carved
    surface, size, inner = carved
    random = np.random.default_rng(0)
    points = np.concatenate([surface, inner.sample(round(len(surface) * INNER / (1.0 - INNER)), random)])
    if len(points) < ENOUGH_POINTS:
        return NoHull(f"Only {len(points)} voxels are left within the outlines of the photos.")
    # In random order, so that the first ones are an even choice.
    points = points[random.permutation(len(points))[:most]].astype(np.float64)
    colors = _colors(used[:: -(-len(used) // COLOR_PHOTOS)], points, size)
    return Hull(points, colors, size)


def at_first(points: int, max_gaussians: int) -> int:
    """Number of Gaussians that start on a hull of so many points."""
    return max(2, min(points, max(RANDOM_GAUSSIANS, round(AT_FIRST * points)), max_gaussians // 2))


def _carved(outlines: Sequence[_Silhouette], most: int) -> tuple[Real, float, _Inner] | NoHull:
    """Centres [n, 3] of the voxels that the hull's surface crosses, their size, and the voxels within."""
    cameras = [outline.camera for outline in outlines]
    centers = np.array([camera.center for camera in cameras])
    middle = looked_at(centers, np.array([camera.axis for camera in cameras]))
    half = float(np.linalg.norm(centers - middle, axis=1).max())
    low, size, finest, level = middle - half, 2.0 * half, 0.0, 0
    index = np.zeros((1, 3), np.int32)
    labels = np.full((1, 1, 1), _KEPT)
    none = np.zeros(1, np.int16)
    votes = _Votes(none, none, none, none, none, none, np.ones((len(outlines), 1), bool))
    surface = np.ones(1, bool)
    corners, sizes = [], []
    # A surface has four times the voxels at half the size, and eight are tried for each.
    while level <= COARSE or (
        size >= 2.0 * finest and 4 * len(index) <= most and 8 * votes.open[:, surface].size <= MOST_PAIRS
    ):
        level, size = level + 1, size / 2.0
        index = (2 * index[:, None, :] + _CORNERS).reshape(-1, 3)
        points = (low + (index + 0.5) * size).astype(np.float32)
        votes = _voted(outlines, votes.parts(surface, 8), points, size)
        outside = votes.outside > votes.wrong
        if level < COARSE:
            unseen = ~outside & (votes.met < LEAST_VIEWS)
        else:
            unseen = ~outside & (votes.shown < max(LEAST_VIEWS, SUPPORT * votes.shown.max(initial=0)))
        surface = ~outside & ~unseen & (votes.outside + votes.crossed > votes.wrong)
        within = ~outside & ~unseen & ~surface
        corners.append((low + index[within] * size).astype(np.float32))
        sizes.append(np.full(int(within.sum()), size))
        if level <= COARSE:
            labels = labels.repeat(2, 0).repeat(2, 1).repeat(2, 2)
            labels[tuple(index[outside].T)] = _OUTSIDE
            labels[tuple(index[unseen].T)] = _UNSEEN
        index, points = index[surface], points[surface]
        if level == COARSE:
            unbounded = _unbounded(labels)
            if unbounded is not None:
                return unbounded
            depths = np.array(
                [np.median(camera.to_camera(points.astype(np.float64))[:, 2]) for camera in cameras]
            )
            finest = PIXELS * float(np.median(depths / [camera.fx for camera in cameras]))
    centre = _voted(outlines, votes.parts(surface, 1), points, 0.0)
    inner = _Inner(np.concatenate(corners), np.concatenate(sizes))
    return points[_thinned(index, centre.outside <= centre.wrong)], size, inner


_OUTSIDE, _UNSEEN, _KEPT = np.int8(0), np.int8(1), np.int8(2)
_CORNERS = (
    np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(8, 3).astype(np.int32)
)


def _voted(outlines: Sequence[_Silhouette], known: _Votes, points: Real, size: float) -> _Votes:
    """`known` with the votes of the photos that are open on the voxels at `points` [n, 3], as spheres of that size.

    size: side of a voxel; 0 for its centre alone.
    """
    shown, met, outside = known.shown.copy(), known.met.copy(), known.outside.copy()
    certain_shown, certain_outside = shown.copy(), outside.copy()
    crossed, open_ = np.zeros_like(shown), np.zeros_like(known.open)
    radius = np.float32(0.5 * np.sqrt(3.0) * size)
    for number, (camera, sums) in enumerate(outlines):
        rows = np.flatnonzero(known.open[number])
        x, y, depth = camera.to_camera(points[rows].astype(np.float64)).astype(np.float32).T
        front = depth > radius + np.float32(MIN_DEPTH)
        # A voxel that reaches behind the camera may fall anywhere.
        open_[number, rows[~front & (depth > -radius)]] = True
        rows, x, y, depth = rows[front], x[front] / depth[front], y[front] / depth[front], depth[front]
        reach = radius / (depth - radius)
        left, right, column = _span(x, reach, camera.fx, camera.cx)
        top, bottom, row = _span(y, reach, camera.fy, camera.cy)
        meets = (right > 0) & (left < camera.width) & (bottom > 0) & (top < camera.height)
        whole = (left >= 0) & (right <= camera.width) & (top >= 0) & (bottom <= camera.height)
        left, right = left.clip(0, camera.width), right.clip(0, camera.width)
        top, bottom = top.clip(0, camera.height), bottom.clip(0, camera.height)
        solid = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
        filled = solid == (right - left) * (bottom - top)
        certain = whole & (filled | (solid == 0))
        empty = whole & (solid == 0)
        met[rows] += meets
        shown[rows] += (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        outside[rows] += empty
        crossed[rows] += meets & ~filled & ~empty
        certain_shown[rows] += certain
        certain_outside[rows] += empty
        open_[number, rows] = meets & ~certain
    return _Votes(shown, met, outside, crossed, certain_shown, certain_outside, open_)


def _span(slope: Real, reach: Real, focal: float, middle: float) -> tuple[Index, Index, Real]:
    """First pixels of spheres, the pixels after their last, and their centres in pixels, along one axis of a photo.

    slope: of the rays through their centres [n]. reach: radius over the least depth [n].
    """
    at = np.float32(focal) * slope + np.float32(middle)
    wide = np.float32(focal) * reach * np.sqrt(1.0 + slope * slope)
    # Beyond these, 32-bit integers overflow.
    first, last = (np.floor(side).clip(-1e8, 1e8).astype(np.int32) for side in (at - wide, at + wide))
    return first, last + 1, at


def _unbounded(labels: npt.NDArray[np.int8]) -> NoHull | None:
    """Why the voxels that are kept are no bounded object; None where outlines bound them."""
    if not (labels == _KEPT).any():
        return NoHull(
            "No place is within the outlines of all photos that show it: the outlines contradict one another, or all "
            "cameras look the same way."
        )
    padded = np.pad(labels, 1, constant_values=_UNSEEN)
    closed = open_ = 0
    for axis in range(3):
        one, other = np.moveaxis(padded, axis, 0)[1:], np.moveaxis(padded, axis, 0)[:-1]
        for kept, beside in ((one, other), (other, one)):
            closed += int(((kept == _KEPT) & (beside == _OUTSIDE)).sum())
            open_ += int(((kept == _KEPT) & (beside == _UNSEEN)).sum())
    share = open_ / max(1, open_ + closed)
    if share > MOST_OPEN:
        return NoHull(
            f"The outlines of the photos do not bound an object: {100 * share:.0f} % of its surface would be the "
            "edge of what the photos show."
        )
    return None


def _thinned(index: Index, inside: Flags) -> Flags:
    """Voxels whose centre is `inside` [n], and one of each eight beside which there is none: parts that are thin."""
    alone = ~inside
    for corner in _CORNERS:
        block = _keys((index + corner) // 2)
        alone &= ~np.isin(block, block[inside])
    rows = np.flatnonzero(alone)
    _, first = np.unique(_keys(index[rows] // 2), return_index=True)
    kept = inside.copy()
    kept[rows[first]] = True
    return kept


def _keys(index: Index) -> npt.NDArray[np.int64]:
    """A number for each triple of indices [n, 3], which are below 2 ** 20."""
    keys: npt.NDArray[np.int64] = index.astype(np.int64) @ np.array([1 << 40, 1 << 20, 1])
    return keys


def _colors(targets: Sequence[Target], points: Float, size: float) -> Pixels:
    """Mean colours uint8 [n, 3] of the points in the photos that show them in front of the hull's other points."""
    total, weight = np.zeros((len(points), 3)), np.full(len(points), 1e-9)
    for target in targets:
        assert target.alpha is not None
        camera = target.camera
        projection = camera.project(points)
        rows = np.flatnonzero(projection.inside)
        if not len(rows):
            continue
        row, column, depth = projection.rows[rows], projection.columns[rows], projection.depths[rows]
        # Twice as many pixels as a voxel covers, so that the surface has no holes.
        cell = max(1.0, 2.0 * size * camera.fx / float(np.median(depth)))
        across, down = int(camera.width / cell) + 1, int(camera.height / cell) + 1
        at = (row / cell).astype(np.int64) * across + (column / cell).astype(np.int64)
        nearest = np.full(across * down, np.inf)
        np.minimum.at(nearest, at, depth)
        row, column = row.astype(np.int64), column.astype(np.int64)
        cover = target.alpha.numpy()[row, column] / 255.0
        # Hidden points count where no photo shows them.
        share = cover * np.where(depth <= nearest[at] + 2.0 * size, 1.0, HIDDEN)
        total[rows] += share[:, None] * target.rgb.numpy()[row, column]
        weight[rows] += share
    colors: Pixels = (total / weight[:, None] + 0.5).clip(0, 255).astype(np.uint8)
    return colors
