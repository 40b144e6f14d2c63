"""Given points judged by the photos: which of them some photo shows in their colour."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from splatmill_worker.images.load import Photo, load_view
from splatmill_worker.scene import WRONG_OUTLINES, View
from splatmill_worker.sfm.callbacks import stop_if

Float = npt.NDArray[np.float64]
Colors = npt.NDArray[np.uint8]
Flags = npt.NDArray[np.bool_]

SIDE = 320
"""Pixels of the longest side of the photos that points are compared with."""

TOLERANCE = 20
"""Grey levels of 255 by which each channel of a point may lie outside those of the 3 x 3 pixels around it
(decisions: loose-points)."""

LOADERS = 4
"""Photos decoded at a time; a request to cancel waits for these."""


@dataclass(frozen=True)
class Evidence:
    """What the photos say about n points. Held-out photos of a data set take no part.

    shown: number of photos in which the point falls on a pixel that counts [n].
    agreeing: number of those that show its colour there [n].
    by_chance: number of those that show the colour of another point, drawn at random, there [n].
    through: number of photos that are transparent there, and in the pixels around [n].
    colors: mean colour of the photos there, RGB [n,3]; grey where no photo shows the point.
    transparent: number of photos with transparent pixels.
    """

    shown: npt.NDArray[np.int64]
    agreeing: npt.NDArray[np.int64]
    by_chance: npt.NDArray[np.int64]
    through: npt.NDArray[np.int64]
    colors: Colors
    transparent: int

    @property
    def inside(self) -> Flags:
        """Points that lie within the outlines of transparent photos [n]; a few of the photos may be wrong."""
        flags: Flags = self.through <= WRONG_OUTLINES * (self.shown + self.through)
        return flags

    @property
    def agreement(self) -> float:
        """Share of the photos that show a point's colour, over all points that photos show; 0 without any."""
        return float(self.agreeing.sum() / max(1, self.shown.sum()))

    @property
    def chance(self) -> float:
        """The same share with the colours exchanged among the points."""
        return float(self.by_chance.sum() / max(1, self.shown.sum()))


def counted_pixels(photo: Photo, row: npt.NDArray[np.int64], column: npt.NDArray[np.int64]) -> Flags:
    """Which pixels [n] of a photo count: neither masked nor more than half transparent."""
    counted = np.ones(len(row), bool)
    if photo.mask is not None:
        counted &= photo.mask[row, column]
    if photo.alpha is not None:
        counted &= photo.alpha[row, column] >= 128
    return counted


def evidence_of(
    points: Float, colors: Colors, views: Sequence[View], cancelled: Callable[[], bool] = lambda: False
) -> Evidence:
    """Compare `points` [n,3] and their `colors` RGB [n,3] with the photos of `views`.

    Raises OSError and ValueError for photos as `load_view` does, and Cancelled.
    """
    count = len(points)
    shown, agreeing, by_chance, through = (np.zeros(count, np.int64) for _ in range(4))
    total = np.zeros((count, 3))
    transparent = 0
    others = colors[np.random.default_rng(0).permutation(count)]
    for photo in photos(views, cancelled):
        projection = photo.camera.project(points)
        rows = np.flatnonzero(projection.inside)
        row, column = projection.rows[rows].astype(np.int64), projection.columns[rows].astype(np.int64)
        if photo.alpha is not None:
            transparent += bool((photo.alpha < 255).any())
            alpha = torch.from_numpy(photo.alpha)[None].float()
            clear = (torch.nn.functional.max_pool2d(alpha, 3, 1, 1)[0] < 1.0).numpy()
            through[rows] += clear[row, column]
        counted = counted_pixels(photo, row, column)
        rows, row, column = rows[counted], row[counted], column[counted]
        planes = torch.from_numpy(photo.rgb).permute(2, 0, 1).float()
        high = torch.nn.functional.max_pool2d(planes, 3, 1, 1).numpy()[:, row, column].T + TOLERANCE
        low = -torch.nn.functional.max_pool2d(-planes, 3, 1, 1).numpy()[:, row, column].T - TOLERANCE
        shown[rows] += 1
        agreeing[rows] += ((colors[rows] <= high) & (colors[rows] >= low)).all(axis=1)
        by_chance[rows] += ((others[rows] <= high) & (others[rows] >= low)).all(axis=1)
        total[rows] += photo.rgb[row, column]
    mean = np.where(shown[:, None] > 0, total / np.maximum(shown, 1)[:, None], 128.0)
    return Evidence(shown, agreeing, by_chance, through, mean.round().astype(np.uint8), transparent)


def photos(views: Sequence[View], cancelled: Callable[[], bool]) -> Iterator[Photo]:
    """The photos at the size of the comparison, a few at a time. Raises Cancelled between two photos."""
    with ThreadPoolExecutor(min(LOADERS, os.cpu_count() or 1)) as pool:
        for start in range(0, len(views), LOADERS):
            stop_if(cancelled)
            yield from pool.map(lambda view: load_view(view, SIDE), views[start : start + LOADERS])
