"""Which photo shows which point, and in which colour: what light, angles and distances are measured from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from splatmill_worker.scene import Scene
from splatmill_worker.splat.start.points import ENOUGH_POINTS
from splatmill_worker.splat.views import TrainingView

Float = npt.NDArray[np.float64]

MAX_POINTS = 4000
"""Points whose observations are compared, evenly chosen and fewer than twice this number: enough for a median."""

ENOUGH_OBSERVATIONS = 40
"""Number of observations below which exposures, angles and distances are not measured."""


@dataclass(frozen=True)
class Observations:
    """Which photo shows which point: n observations, without those of held-out photos.

    points, photos: number of points of the scene and of photos.
    point, photo: indices of the observation's point and photo [n].
    color: colour of the photo there, uint8 [n, 3].
    footprint: width of a pixel at the point's depth [n], in units of the world.
    direction: unit vector from the camera to the point [n, 3].
    """

    points: int
    photos: int
    point: npt.NDArray[np.int64]
    photo: npt.NDArray[np.int64]
    color: npt.NDArray[np.uint8]
    footprint: Float
    direction: Float

    @staticmethod
    def of(scene: Scene, views: Sequence[TrainingView]) -> Observations | None:
        """The observations of the scene's tracks in `views`; None without tracks, or with too few of them."""
        if scene.point_views is None or len(scene.points) < ENOUGH_POINTS:
            return None
        number = {view.name: i for i, view in enumerate(views)}
        of_scene = np.array([number.get(view.name, -1) for view in scene.views], dtype=np.int64)
        offsets, track = scene.point_views
        point = np.repeat(np.arange(len(scene.points)), np.diff(offsets))
        photo = of_scene[track]
        stride = max(1, len(scene.points) // MAX_POINTS)
        keep = (photo >= 0) & (point % stride == 0)
        point, photo = point[keep], photo[keep]
        columns: list[tuple[Any, ...]] = []
        for i, view in enumerate(views):
            rows = point[photo == i]
            camera, rgb = view.full.camera, view.full.rgb.numpy()
            projection = camera.project(scene.points[rows])
            rows, z = rows[projection.inside], projection.depths[projection.inside]
            color = rgb[
                projection.rows[projection.inside].astype(np.int64),
                projection.columns[projection.inside].astype(np.int64),
            ]
            away = scene.points[rows] - camera.center
            direction = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
            columns.append((rows, np.full(len(rows), i), color, z / camera.fx, direction))
        joined = [np.concatenate(column) for column in zip(*columns, strict=True)]
        if len(joined[0]) < ENOUGH_OBSERVATIONS:
            return None
        return Observations(len(scene.points), len(views), *joined)

    def view_angle(self, first: int) -> float | None:
        """Median over the `first` points of the largest angle between two views, degrees; None without any."""
        own = self.point < first
        if not own.any():
            return None
        return float(np.median([_widest(rows) for rows in _by_point(self.point[own], self.direction[own])]))

    def distance_ratio(self) -> float:
        """Largest over smallest footprint of a pixel on the same point, 90th percentile over points."""
        ratios = [rows.max() / rows.min() for rows in _by_point(self.point, self.footprint)]
        return float(np.percentile(ratios, 90))


def _by_point(point: npt.NDArray[np.int64], values: Float) -> list[Float]:
    """The values of each point's observations: of points with at least two, or of all where no point has two."""
    order = np.argsort(point, kind="stable")
    starts = np.flatnonzero(np.diff(point[order], prepend=-1))
    groups = np.split(values[order], starts[1:])
    return [group for group in groups if len(group) >= 2] or groups


def _widest(directions: Float) -> float:
    """Largest angle between two of the unit vectors [n, 3], degrees."""
    return float(np.degrees(np.arccos(np.clip((directions @ directions.T).min(), -1.0, 1.0))))
