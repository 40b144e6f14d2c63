"""Points without colours judged by the photos: a point on a surface has much the same colour in all that see it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatmill_worker.scene import Float, View
from splatmill_worker.sfm.posed.judged.evidence import Colors, counted_pixels, photos
from splatmill_worker.sfm.posed.judged.visible import visible

MOST_PHOTOS = 48
"""Photos that are compared, at most, evenly chosen."""

SPREAD = 0.8
"""Share of the spread by chance that the colours of a point have at most, if the points are where the photos show them
(decisions: uncolored)."""

ONE_COLOR = 4.0
"""Spread by chance, in levels, up to which the photos show one colour, and tell nothing."""

CHUNK = 20_000
"""Points whose medians are taken at once."""

LEAST_PAIRED = 20
"""Points in two photos or more, below which the photos do not tell anything."""


@dataclass(frozen=True)
class PointColors:
    """What the photos show at n points.

    counts: number of compared photos that see each point, by the depths of all points [n].
    colors: median colour in these, RGB [n,3]; grey where none sees the point.
    spread: mean difference of the colours of a point from their median, in levels, over points in two photos or more.
    by_chance: the same with the colours exchanged among the points of each photo.
    paired: number of points in two photos or more.
    """

    counts: npt.NDArray[np.int64]
    colors: Colors
    spread: float
    by_chance: float
    paired: int

    @property
    def fits(self) -> bool:
        """Whether photos agree on the colours of the points more than by chance."""
        return self.paired >= LEAST_PAIRED and self.spread < SPREAD * self.by_chance

    @property
    def contradicted(self) -> bool:
        """Whether photos agree no more than by chance, where they have enough points and colours to tell."""
        return self.paired >= LEAST_PAIRED and self.by_chance > ONE_COLOR and not self.fits


def seen_in(
    points: Float, views: Sequence[View], cancelled: Callable[[], bool] = lambda: False
) -> PointColors:
    """Compare the photos of `views` at `points` [n,3]. Raises as `evidence.evidence_of` does."""
    chosen = views[:: max(1, -(-len(views) // MOST_PHOTOS))]
    shape = len(chosen), len(points), 3
    own, other = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
    there = np.zeros(shape[:2], bool)
    random = np.random.default_rng(0)
    for index, photo in enumerate(photos(chosen, cancelled)):
        place = photo.camera.project(points)
        rows = visible(photo.camera, place)
        row, column = place.rows[rows].astype(np.int64), place.columns[rows].astype(np.int64)
        counted = counted_pixels(photo, row, column)
        rows, row, column = rows[counted], row[counted], column[counted]
        there[index, rows] = True
        own[index, rows] = photo.rgb[row, column]
        other[index, rows] = own[index, random.permutation(rows)]
    counts = there.sum(axis=0)
    paired = counts >= 2
    colors = np.full((len(points), 3), 128, np.uint8)
    sums = np.zeros(2)
    for start in range(0, len(points), CHUNK):
        part = slice(start, start + CHUNK)
        middle, apart = _medians(own[:, part], there[:, part])
        some = counts[part] > 0
        colors[part][some] = middle[some].round().astype(np.uint8)
        sums += apart[paired[part]].sum(), _medians(other[:, part], there[:, part])[1][paired[part]].sum()
    spread, by_chance = (float(value) for value in sums / max(1, int(paired.sum())))
    return PointColors(counts.astype(np.int64), colors, spread, by_chance, int(paired.sum()))


def _medians(
    samples: npt.NDArray[np.uint8], there: npt.NDArray[np.bool_]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Medians [n,3] of the samples [photos,n,3] that are there, and their mean differences from these [n]."""
    values = np.where(there[:, :, None], samples.astype(np.float32), np.nan)
    some = there.any(axis=0)
    middle = np.zeros(samples.shape[1:], np.float32)
    apart = np.zeros(samples.shape[1], np.float32)
    if some.any():
        middle[some] = np.nanmedian(values[:, some], axis=0)
        apart[some] = np.nanmean(np.abs(values[:, some] - middle[some]).mean(axis=2), axis=0)
    return middle, apart
