"""The camera path of an orbit video, laid through where the photos were taken."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatmill.schema import ModelCameras, OrbitRequest
from splatmill_worker.scene import Camera, looked_at, viewmat_of

Float = npt.NDArray[np.float64]

FULL_CIRCLE = math.radians(220)
"""Photos that cover less than this are of one side: the camera then swings to and fro before that side, for
behind it nothing was ever seen."""

DEFAULT_FOV = 50.0
_SWING_RISE = 0.15


@dataclass(frozen=True)
class Path3:
    """A closed path around `target`: `radius` and `height` along `up`, azimuths middle +- half from `right`.

    All lengths in world units; right, up and front are orthonormal.
    """

    target: Float
    right: Float
    front: Float
    up: Float
    radius: float
    height: float
    middle: float
    half: float

    def eye(self, share: float) -> Float:
        """The camera's position at a share 0..1 of the video."""
        turn = 2 * math.pi * share
        if self.half >= math.pi:
            azimuth, height = self.middle + turn, self.height
        else:
            azimuth = self.middle + self.half * math.sin(turn)
            height = self.height + _SWING_RISE * self.radius * math.cos(turn) * min(1.0, self.half)
        around = math.cos(azimuth) * self.right + math.sin(azimuth) * self.front
        return self.target + self.radius * around + height * self.up


def path_through(centers: Float, forwards: Float, ups: Float) -> Path3:
    """The path that fits cameras: positions [N,3], viewing directions [N,3] and upward directions [N,3].

    The target is the point nearest to all optical axes (least squares); where the axes are as good as parallel,
    it lies before the cameras at their own spread.
    """
    up = _unit(ups.mean(axis=0), np.array([0.0, 0.0, 1.0]))
    target = _nearest_to_axes(centers, forwards)
    offsets = centers - target
    heights = offsets @ up
    flat = offsets - heights[:, None] * up
    right = _unit(flat[0], _any_normal(up))
    front = np.cross(up, right)
    azimuths = np.arctan2(flat @ front, flat @ right)
    middle, half = _arc(azimuths)
    if 2 * half >= FULL_CIRCLE:
        half = math.pi
    radius = float(np.median(np.linalg.norm(flat, axis=1)))
    return Path3(target, right, front, up, radius, float(np.median(heights)), middle, half)


def path_around(points: Float) -> Path3:
    """The path around a model without cameras: points [N,3] with z up, seen from two and a half radii."""
    target = np.median(points, axis=0)
    reach = float(np.quantile(np.linalg.norm(points - target, axis=1), 0.8)) or 1.0
    x, y, z = np.eye(3)
    return Path3(target, x, y, z, 2.5 * reach, 0.5 * reach, 0.0, math.pi)


def cameras_along(path: Path3, wish: OrbitRequest, fov_y_deg: float) -> Iterable[Camera]:
    """One engine camera per frame, looking at the target."""
    focal = 0.5 * wish.height / math.tan(math.radians(fov_y_deg) / 2)
    for index in range(wish.frames):
        eye = path.eye(index / wish.frames)
        forward = _unit(path.target - eye, path.front)
        right = _unit(np.cross(forward, path.up), path.right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        viewmat = viewmat_of(rotation, eye)
        yield Camera(wish.width, wish.height, focal, focal, wish.width / 2, wish.height / 2, viewmat)


def of_model(stored: ModelCameras | None, points: Float, wish: OrbitRequest) -> Iterable[Camera]:
    """The cameras of a video of a model whose photos were taken by `stored`, around `points` [N,3] without."""
    if stored is None or len(stored.cameras) < 2:
        return cameras_along(path_around(points), wish, wish.fov_y_deg or DEFAULT_FOV)
    poses = np.array([camera.camera.opencv_to_world() for camera in stored.cameras])
    path = path_through(poses[:, :3, 3], poses[:, :3, 2], -poses[:, :3, 1])
    return cameras_along(path, wish, wish.fov_y_deg or _field_of_view(stored, wish))


def _nearest_to_axes(centers: Float, forwards: Float) -> Float:
    spread = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).mean()) or 1.0
    alignment = np.linalg.eigvalsh(forwards.T @ forwards / len(forwards))[-1]  # 1 for parallel axes
    if alignment < 1.0 - 1e-3:
        nearest = looked_at(centers, forwards, ridge=0.0)
        # Axes that only seem to meet do so behind the cameras or far out.
        if np.median(np.einsum("nj,nj->n", nearest - centers, forwards)) > 0.1 * spread:
            return nearest
    middle: Float = centers.mean(axis=0)
    return middle + 3 * spread * _unit(forwards.mean(axis=0), forwards[0])


def _arc(azimuths: Float) -> tuple[float, float]:
    """Middle and half width of the smallest arc that holds all azimuths (radians)."""
    ordered = np.sort(azimuths)
    gaps = np.diff(np.append(ordered, ordered[0] + 2 * math.pi))
    widest = int(np.argmax(gaps))
    start = float(ordered[(widest + 1) % len(ordered)])
    half = (2 * math.pi - float(gaps[widest])) / 2
    return start + half, half


def _field_of_view(stored: ModelCameras, wish: OrbitRequest) -> float:
    """Vertical angle in degrees that shows about what the photos show, in width and height."""
    tangents = []
    for camera in stored.cameras:
        fx, fy, _, _ = camera.camera.pinhole()
        tangents.append((camera.camera.width / (2 * fx), camera.camera.height / (2 * fy)))
    wide, high = np.median(np.array(tangents), axis=0)
    return math.degrees(2 * math.atan(max(float(high), float(wide) * wish.height / wish.width)))


def _unit(vector: Float, otherwise: Float) -> Float:
    length = float(np.linalg.norm(vector))
    if length < 1e-9:
        return otherwise
    unit: Float = vector / length
    return unit


def _any_normal(vector: Float) -> Float:
    axis = np.eye(3)[int(np.argmin(np.abs(vector)))]
    return _unit(np.cross(vector, axis), axis)
