"""What can be measured about a scene in seconds, before it is decided how to train it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import psutil
import torch

from splatmill_worker.scene import Scene
from splatmill_worker.splat.views import TrainingView

Float = npt.NDArray[np.float64]
MAX_POINTS = 4000  # enough for a median, and a fraction of a second


@dataclass(frozen=True)
class Speed:
    """Seconds per training step, from a short probe: a part per pixel and a part per Gaussian."""

    per_pixel: float
    per_gaussian: float

    def step(self, pixels: float, gaussians: float) -> float:
        """Seconds of one step."""
        return self.per_pixel * pixels + self.per_gaussian * gaussians


@dataclass(frozen=True)
class Facts:
    """Figures of one scene at the size of the loaded photos. None: it cannot be measured here.

    exposure_spread: robust standard deviation between photos of the log brightness of the same points.
    halving_loss: median RMS difference, in grey levels of 255, between a photo and its half-size copy enlarged.
    view_angle: median over points of the largest angle between two views of it, in degrees. distance_ratio:
    90th percentile over points of largest over smallest pixel footprint. depth_ratio: 95th over 5th percentile
    of depths. reprojection: median error of the points in pixels.
    """

    views: int
    held_out: int
    width: int
    height: int
    native_longest: int
    points: int
    source: str
    transparent: int
    masked: int
    distorted: int
    halving_loss: float
    exposure_spread: float | None
    view_angle: float | None
    distance_ratio: float | None
    depth_ratio: float | None
    reprojection: float | None
    memory_available: int
    speed: Speed | None = None

    @property
    def pixels(self) -> int:
        """Of one photo."""
        return self.width * self.height

    def as_dict(self) -> dict[str, Any]:
        """For the report."""
        return asdict(self)


def measure(scene: Scene, views: Sequence[TrainingView], held_out: int, speed: Speed | None) -> Facts:
    """Facts of `scene` (in any frame) whose training photos are `views`, in the same frame."""
    sizes = np.array([[view.full.camera.width, view.full.camera.height] for view in views])
    width, height = (int(value) for value in np.median(sizes, axis=0))
    seen = _Sightings.of(scene, views)
    return Facts(
        views=len(views),
        held_out=held_out,
        width=width,
        height=height,
        native_longest=max((max(view.camera.width, view.camera.height) for view in scene.views), default=0),
        points=len(scene.points),
        source=scene.source,
        transparent=sum(view.full.alpha is not None for view in views),
        masked=sum(view.full.mask is not None for view in views),
        distorted=sum(view.lens is not None for view in scene.views),
        halving_loss=float(np.median([halving_loss(view.full.rgb) for view in views])),
        exposure_spread=None if seen is None else exposure_spread(seen),
        view_angle=None if seen is None else seen.view_angle(),
        distance_ratio=None if seen is None else seen.distance_ratio(),
        depth_ratio=None if seen is None else seen.depth_ratio(),
        reprojection=_median(scene.point_errors),
        memory_available=int(psutil.virtual_memory().available),
        speed=speed,
    )


def halving_loss(rgb: torch.Tensor) -> float:
    """RMS difference in grey levels between a photo uint8 [H, W, 3] and its half-size copy enlarged again."""
    planes = rgb.permute(2, 0, 1)[None].float()
    height, width = planes.shape[2:]
    if min(height, width) < 4:
        return math.inf
    small = torch.nn.functional.interpolate(planes, size=(height // 2, width // 2), mode="area")
    again = torch.nn.functional.interpolate(small, size=(height, width), mode="bicubic", align_corners=False)
    return float((again - planes).square().mean().sqrt())


def exposure_spread(seen: _Sightings) -> float | None:
    """Spread of the photos' log exposures, from points that several photos show.

    Each sighting's log brightness is a point's own plus its photo's; the photos' parts are solved for by
    alternating medians, which outliers (highlights, occlusions) do not move.
    """
    log = np.log(np.maximum(seen.brightness, 4.0))
    exposure = np.zeros(seen.photos)
    for _ in range(8):
        point = _group_median(log - exposure[seen.photo], seen.point, seen.points)
        exposure = _group_median(log - point[seen.point], seen.photo, seen.photos)
        exposure -= np.median(exposure)
    enough = np.bincount(seen.photo, minlength=seen.photos) >= 10
    if enough.sum() < 3:
        return None
    return float(1.4826 * np.median(np.abs(exposure[enough] - np.median(exposure[enough]))))


@dataclass(frozen=True)
class _Sightings:
    """Which photo shows which point, one row each: indices, brightness 0..255, distance over focal length."""

    points: int
    photos: int
    point: npt.NDArray[np.int64]
    photo: npt.NDArray[np.int64]
    brightness: Float
    depth: Float
    footprint: Float
    direction: Float

    @staticmethod
    def of(scene: Scene, views: Sequence[TrainingView]) -> _Sightings | None:
        """None without tracks (which photo sees which point), or with too few of them."""
        if scene.point_views is None or len(scene.points) < 20:
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
            local = scene.points[rows] @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
            z = np.maximum(local[:, 2], 1e-9)
            u = (local[:, 0] / z * camera.fx + camera.cx).astype(np.int64)
            v = (local[:, 1] / z * camera.fy + camera.cy).astype(np.int64)
            on = (local[:, 2] > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
            away = scene.points[rows[on]] - camera.center
            direction = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
            bright = rgb[v[on], u[on]].mean(axis=1)
            columns.append((rows[on], np.full(on.sum(), i), bright, z[on], z[on] / camera.fx, direction))
        joined = [np.concatenate(column) for column in zip(*columns, strict=True)]
        if len(joined[0]) < 40:
            return None
        return _Sightings(len(scene.points), len(views), *joined)

    def view_angle(self) -> float:
        """Median over points of the largest angle between two of its views, in degrees."""
        return float(np.median([_widest(rows) for rows in self._by_point(self.direction)]))

    def distance_ratio(self) -> float:
        """90th percentile over points of the largest over the smallest footprint of a pixel on it."""
        return float(np.percentile([rows.max() / rows.min() for rows in self._by_point(self.footprint)], 90))

    def depth_ratio(self) -> float:
        """95th over 5th percentile of all depths."""
        low, high = np.percentile(self.depth, [5, 95])
        return float(high / max(low, 1e-12))

    def _by_point(self, values: Float) -> list[Float]:
        order = np.argsort(self.point, kind="stable")
        starts = np.flatnonzero(np.diff(self.point[order], prepend=-1))
        groups = np.split(values[order], starts[1:])
        return [group for group in groups if len(group) >= 2] or groups


def _widest(directions: Float) -> float:
    return float(np.degrees(np.arccos(np.clip((directions @ directions.T).min(), -1.0, 1.0))))


def _median(values: npt.NDArray[Any] | None) -> float | None:
    return None if values is None or not len(values) else float(np.median(values))


def _group_median(values: Float, group: npt.NDArray[np.int64], groups: int) -> Float:
    """Median of `values` per group; 0 where a group is empty."""
    order = np.lexsort((values, group))
    counts = np.bincount(group, minlength=groups)
    starts = np.cumsum(counts) - counts
    result = np.zeros(groups)
    filled = counts > 0
    result[filled] = values[order][starts[filled] + counts[filled] // 2]
    return result
