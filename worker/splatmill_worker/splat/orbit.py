"""The cameras of a video: on a circle fitted to the positions from which the photos were taken, or on a given path."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatmill.schema import CameraPath, ModelCameras, OrbitRequest
from splatmill_worker.scene import Camera, looked_at, viewmat_of
from splatmill_worker.splat.gaussians import Gaussians

Float = npt.NDArray[np.float64]

FULL_CIRCLE = math.radians(220)
"""Radians of azimuth that photos must cover for a full circle. If they cover less, the camera swings back and forth
within the arc of the photos, because no photo shows the model from outside of it."""

UP: Float = np.array([0.0, -1.0, 0.0])
"""The axis that points up in a model without cameras, unless `--up` names another: y points down in a `.ply`, and every
other format is turned into its frame when it is read."""

MIDDLE = 4.0
"""Radius of the dense middle of a model, in median distances from its centre; far shells lie outside of it."""

DEFAULT_FOV = 50.0
"""Vertical field of view in degrees where neither the request nor the photos give one."""

_SWING_RISE = 0.15
"""Largest rise and fall of a swinging camera over the path's height, as a share of the path's radius."""


@dataclass(frozen=True)
class OrbitPath:
    """A closed camera path around a target.

    target: the point that the camera faces, [3], in world units.
    right, front, up: orthonormal axes, [3] each; azimuths are measured from `right` towards `front`.
    radius: distance from the vertical axis through the target, in world units.
    height: height above the target along `up`, in world units.
    middle, half: the arc of the camera: middle and half of its width in radians; a half of pi is a full circle.
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
        """Return the position [3] of the camera at a share of the video, 0 to 1."""
        turn = 2 * math.pi * share
        if self.half >= math.pi:
            azimuth, height = self.middle + turn, self.height
        else:
            azimuth = self.middle + self.half * math.sin(turn)
            height = self.height + _SWING_RISE * self.radius * math.cos(turn) * min(1.0, self.half)
        around = math.cos(azimuth) * self.right + math.sin(azimuth) * self.front
        return self.target + self.radius * around + height * self.up

    def viewmat(self, share: float) -> Float:
        """Return the world-to-camera matrix [4,4] of the camera at a share of the video, which faces the target."""
        eye = self.eye(share)
        forward = _unit(self.target - eye, self.front)
        right = _unit(np.cross(forward, self.up), self.right)
        return viewmat_of(np.stack([right, np.cross(forward, right), forward]), eye)


def fit_path(
    centers: Float, forwards: Float, ups: Float, *, up: Float | None = None, focus: Float | None = None
) -> OrbitPath:
    """Return the path that fits cameras: their positions, viewing directions and upward directions, [N,3] each.

    up: what is known to be up, [3]; None: the mean of `ups`.
    focus: what the cameras look at, [3]: the target if it is ahead of most of them. Otherwise, and for None, the target
    is the point nearest to all optical axes (least squares). Where these are almost parallel, or meet behind the
    cameras, it lies in front of the cameras' mean position, at three times their mean distance from there.
    """
    up = _unit(ups.mean(axis=0), np.array([0.0, 0.0, 1.0])) if up is None else up
    if focus is None or not _ahead(focus, centers, forwards):
        focus = _nearest_to_axes(centers, forwards)
    target = focus
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
    return OrbitPath(target, right, front, up, radius, float(np.median(heights)), middle, half)


def path_around(points: Float, opacities: Float, up: Float = UP) -> OrbitPath:
    """Return a full circle around the dense middle of a model without cameras.

    points, opacities: of its Gaussians, [N,3] and [N]. up: a coordinate axis, [3].

    The target is the median point by opacity. The radius is 2.5 times the distance from there within which 95 % of the
    opacity of the dense middle lies.
    """
    target = np.array([_quantile(axis, opacities, 0.5) for axis in points.T])
    distances = np.linalg.norm(points - target, axis=1)
    dense = distances <= MIDDLE * _quantile(distances, opacities, 0.5)
    reach = _quantile(distances[dense], opacities[dense], 0.95) or 1.0
    right = np.eye(3)[1 if up[0] else 0]
    return OrbitPath(target, right, np.cross(up, right), up, 2.5 * reach, 0.5 * reach, 0.0, math.pi)


def path_of(gaussians: Gaussians, up: Float = UP) -> OrbitPath:
    """Return `path_around` of Gaussians on any device."""
    opacities = gaussians.logit_opacities.sigmoid()
    return path_around(gaussians.means.double().cpu().numpy(), opacities.double().cpu().numpy(), up)


def cameras_along(path: OrbitPath, request: OrbitRequest, fov_y_deg: float) -> Iterable[Camera]:
    """Yield one camera per frame, looking at the path's target. fov_y_deg: vertical field of view in degrees."""
    focal = 0.5 * request.height / math.tan(math.radians(fov_y_deg) / 2)
    for index in range(request.frames):
        viewmat = path.viewmat(index / request.frames)
        yield Camera(
            request.width, request.height, focal, focal, request.width / 2, request.height / 2, viewmat
        )


def cameras_on(path: CameraPath, request: OrbitRequest) -> Iterable[Camera]:
    """Yield one camera per frame on a path. The last is at its end, or one frame before its start if it is closed."""
    steps = request.frames if path.closed else max(1, request.frames - 1)
    for index in range(request.frames):
        view = path.at(index / steps)
        focal = 0.5 * request.height / math.tan(math.radians(view.fov_y_deg) / 2)
        pose = np.array(view.camera_to_world)
        viewmat = viewmat_of(pose[:3, :3].T, pose[:3, 3])
        yield Camera(
            request.width, request.height, focal, focal, request.width / 2, request.height / 2, viewmat
        )


def orbit_cameras(
    stored: ModelCameras | None, gaussians: Gaussians, request: OrbitRequest, up: Float = UP
) -> Iterable[Camera]:
    """Return the cameras of a video of a model.

    stored: the cameras of its photos; None, or fewer than two, gives a circle around the dense middle.
    gaussians: the model.
    request: number and size of the frames, the field of view if given, and the path in place of a circle if given.
    up: the coordinate axis that points up where there are no cameras, [3].
    """
    if request.camera_path is not None:
        return cameras_on(request.camera_path, request)
    if stored is None or len(stored.cameras) < 2:
        return cameras_along(path_of(gaussians, up), request, request.fov_y_deg or DEFAULT_FOV)
    poses = np.array([camera.camera.opencv_to_world() for camera in stored.cameras])
    centers, forwards = poses[:, :3, 3], poses[:, :3, 2]
    known = {} if stored.up is None else {"up": np.array(stored.up), "focus": np.zeros(3)}
    path = fit_path(centers, forwards, -poses[:, :3, 1], **known)
    return cameras_along(path, request, request.fov_y_deg or _field_of_view(stored, request))


def _quantile(values: Float, weights: Float, share: float) -> float:
    """Return the least of `values` [N] up to which the share of the sum of `weights` [N] lies; N is not 0."""
    order = np.argsort(values)
    sums = np.cumsum(weights[order])
    return float(values[order[min(np.searchsorted(sums, share * sums[-1]), len(order) - 1)]])


def _ahead(point: Float, centers: Float, forwards: Float) -> bool:
    """Whether a point lies ahead of most cameras, by more than a tenth of their mean distance from their mean."""
    depths = np.einsum("nj,nj->n", point - centers, forwards)
    return float(np.median(depths)) > 0.1 * _spread(centers)


def _spread(centers: Float) -> float:
    return float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).mean()) or 1.0


def _nearest_to_axes(centers: Float, forwards: Float) -> Float:
    alignment = np.linalg.eigvalsh(forwards.T @ forwards / len(forwards))[-1]  # 1 for parallel axes
    if alignment < 1.0 - 1e-3:
        nearest = looked_at(centers, forwards, ridge=0.0)
        # Axes that do not converge can have their nearest point behind the cameras.
        if _ahead(nearest, centers, forwards):
            return nearest
    middle: Float = centers.mean(axis=0)
    return middle + 3 * _spread(centers) * _unit(forwards.mean(axis=0), forwards[0])


def _arc(azimuths: Float) -> tuple[float, float]:
    """Return middle and half width of the smallest arc that holds all azimuths, in radians."""
    ordered = np.sort(azimuths)
    gaps = np.diff(np.append(ordered, ordered[0] + 2 * math.pi))
    widest = int(np.argmax(gaps))
    start = float(ordered[(widest + 1) % len(ordered)])
    half = (2 * math.pi - float(gaps[widest])) / 2
    return start + half, half


def _field_of_view(stored: ModelCameras, request: OrbitRequest) -> float:
    """Return the vertical field of view in degrees that shows at least what the median photo shows."""
    tangents = []
    for camera in stored.cameras:
        fx, fy, _, _ = camera.camera.pinhole()
        tangents.append((camera.camera.width / (2 * fx), camera.camera.height / (2 * fy)))
    wide, high = np.median(np.array(tangents), axis=0)
    return math.degrees(2 * math.atan(max(float(high), float(wide) * request.height / request.width)))


def _unit(vector: Float, otherwise: Float) -> Float:
    length = float(np.linalg.norm(vector))
    if length < 1e-9:
        return otherwise
    unit: Float = vector / length
    return unit


def _any_normal(vector: Float) -> Float:
    axis = np.eye(3)[int(np.argmin(np.abs(vector)))]
    return _unit(np.cross(vector, axis), axis)
