"""A scene as the trainer takes it: photos with cameras, sparse points, and the held-out split.

Cameras follow OpenCV: x right, y down, z forward, world-to-camera matrices, and the centre of the first
pixel at (0.5, 0.5). Everything here is float64; `Normalization` makes it small enough for float32.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float64]
Real = npt.NDArray[np.floating[Any]]
Source = Literal["sfm", "colmap", "transforms", "blender"]

MIN_DEPTH = 1e-9
"""World units: a point that is not at least this far in front of a camera has no position on its photo."""


@dataclass(frozen=True)
class Lens:
    """How the photo itself was projected, when that was not a plain pinhole.

    `model` and `params` are COLMAP's (e.g. OPENCV: fx, fy, cx, cy, k1, k2, p1, p2), in pixels of a photo
    of `width` x `height`.
    """

    model: str
    params: tuple[float, ...]
    width: int
    height: int


class Projection(NamedTuple):
    """Where n points fall on a photo.

    columns, rows: position in pixels, float64 [n]; the first pixel covers 0 to 1. NaN where the point is not in
        front of the camera.
    depths: distance from the plane through the camera's centre along the optical axis, float64 [n], in world units.
    inside: whether the point is in front of the camera and within the photo, bool [n]; False for NaN.
    """

    columns: Float
    rows: Float
    depths: Float
    inside: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    width, height: size of the photo, in pixels.
    fx, fy: focal lengths, in pixels.
    cx, cy: principal point, in pixels; the centre of the first pixel is at 0.5.
    viewmat: rigid world-to-camera matrix, float64 [4,4].
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    viewmat: Float

    @property
    def K(self) -> Float:
        """The intrinsic matrix [3,3]."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def center(self) -> Float:
        """The camera's position in the world [3]."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    @property
    def axis(self) -> Float:
        """The viewing direction in the world, a unit vector [3]."""
        axis: Float = self.viewmat[2, :3]
        return axis

    def to_camera(self, points: Float) -> Float:
        """World points [n,3] in the camera's frame (x right, y down, z forward)."""
        local: Float = points @ self.viewmat[:3, :3].T + self.viewmat[:3, 3]
        return local

    def to_world(self, local: Float) -> Float:
        """Points [n,3] of the camera's frame in the world."""
        points: Float = (local - self.viewmat[:3, 3]) @ self.viewmat[:3, :3]
        return points

    def project(self, points: Float) -> Projection:
        """Where world points [n,3] fall on the photo; points with NaN or infinite coordinates are not inside."""
        with np.errstate(invalid="ignore", over="ignore"):
            local = self.to_camera(points)
            depths = local[:, 2]
            safe = np.where(depths > MIN_DEPTH, depths, np.nan)
            columns = local[:, 0] / safe * self.fx + self.cx
            rows = local[:, 1] / safe * self.fy + self.cy
        inside = (columns >= 0) & (columns < self.width) & (rows >= 0) & (rows < self.height)
        return Projection(columns, rows, depths, inside)

    def normalized(self, columns: Any, rows: Any) -> tuple[Any, Any]:
        """Normalised image coordinates: x and y of the rays (x, y, 1) through pixel positions, in the camera's frame.

        `columns` and `rows` are numpy arrays or torch tensors of any shape; the results have their type and dtype.
        """
        return (columns - self.cx) / self.fx, (rows - self.cy) / self.fy

    def unproject(self, columns: Real, rows: Real, depths: Real) -> Float:
        """World points [n,3] at pixel positions [n] and depths [n]: the inverse of `project`."""
        x, y = self.normalized(columns, rows)
        return self.to_world(np.stack([x * depths, y * depths, depths], axis=1))

    def moved_to(self, center: Float) -> Camera:
        """The same camera with its centre at `center` [3]."""
        return replace(self, viewmat=viewmat_of(self.viewmat[:3, :3], center))

    def scaled_to(self, width: int, height: int) -> Camera:
        """The same camera for a photo resampled to `width` x `height` pixels."""
        x, y = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y
        )


def viewmat_of(rotation: Float, center: Float) -> Float:
    """The world-to-camera matrix [4,4] of a camera with the world-to-camera `rotation` [3,3] at `center` [3]."""
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ center
    return viewmat


def looked_at(centers: Float, axes: Float, ridge: float = 1e-3) -> Float:
    """The point [3] with the least sum of squared distances to all optical axes.

    centers, axes: positions and viewing directions [n,3] of the cameras; directions of any length.
    ridge: weight per camera of the squared distance to the cameras' mean position. Parallel axes leave the point
        undetermined; the ridge then keeps it near the cameras. With 0, parallel axes raise numpy's LinAlgError.
    """
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    across = np.eye(3)[None] - axes[:, :, None] * axes[:, None, :]
    middle = centers.mean(axis=0)
    right = (across @ (centers - middle)[:, :, None]).sum(axis=0)[:, 0]
    target: Float = middle + np.linalg.solve(across.sum(axis=0) + ridge * len(centers) * np.eye(3), right)
    return target


@dataclass(frozen=True)
class View:
    """One photo and its camera.

    `camera` is the pinhole camera of the undistorted photo at its own size; `lens` says how the file itself
    was projected (None: it is that pinhole). `upright` says whether the camera describes the photo after its
    EXIF orientation was applied. `split` is given only by data sets that bring their own.
    """

    name: str
    camera: Camera
    image: Path
    mask: Path | None = None
    lens: Lens | None = None
    split: Literal["train", "test"] | None = None
    upright: bool = True


class PointViews(NamedTuple):
    """Which views see each point, in rows: point i is seen by `views[offsets[i]:offsets[i + 1]]`."""

    offsets: npt.NDArray[np.int64]
    views: npt.NDArray[np.int32]


@dataclass(frozen=True)
class Scene:
    """Posed photos and the sparse points, [M,3] float64 with colours [M,3] uint8 and errors in pixels [M].

    `facts` are the figures measured on the way, `left_out` the photos that have no camera, with the reason,
    and `notes` sentences for a person.
    """

    views: tuple[View, ...]
    points: Float
    colors: npt.NDArray[np.uint8]
    source: Source
    point_errors: Float | None = None
    track_lengths: npt.NDArray[np.int32] | None = None
    point_views: PointViews | None = None
    facts: dict[str, Any] = field(default_factory=dict)
    left_out: tuple[tuple[str, str], ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def centers(self) -> Float:
        """The cameras' positions [views,3]."""
        return np.array([view.camera.center for view in self.views]).reshape(-1, 3)


def split(scene: Scene, holdout: int = 8) -> tuple[tuple[View, ...], tuple[View, ...]]:
    """Training and held-out views: of all views sorted by name, every `holdout`-th from the first is held out.

    0 holds none out. A data set's own split wins over the rule. With fewer than two views, nothing is held out.
    """
    views = sorted(scene.views, key=lambda view: view.name)
    if holdout < 0:
        raise ValueError(f"holdout is {holdout}; it must be 0 (none) or the distance between held-out views.")
    own = [view for view in views if view.split == "test"]
    if own and holdout:
        return tuple(view for view in views if view.split != "test"), tuple(own)
    if own or holdout == 0 or len(views) < 2:
        return tuple(view for view in views if view.split != "test"), ()
    if holdout == 1:
        raise ValueError("holdout is 1: every view would be held out and none trained. Use 2 or more, or 0.")
    test = tuple(views[::holdout])
    names = {view.name for view in test}
    return tuple(view for view in views if view.name not in names), test


@dataclass(frozen=True)
class Normalization:
    """The similarity x' = scale * x + translation between the scene's own world and the training world.

    Kept in float64: a geo-referenced scene at northing 5e6 has steps of 0.5 m in float32.
    """

    scale: float
    translation: Float

    @staticmethod
    def of(scene: Scene) -> Normalization:
        """Centres the cameras on the origin and puts the farthest at distance 1.

        Where the cameras do not spread (a single view, a turning tripod), the median depth of the points
        sets the scale instead; with no points either, the scale stays 1.
        """
        centers = scene.centers
        middle = centers.mean(axis=0) if len(centers) else np.zeros(3)
        radius = float(np.linalg.norm(centers - middle, axis=1).max(initial=0.0))
        depth = float(np.median(np.linalg.norm(scene.points - middle, axis=1))) if len(scene.points) else 0.0
        if not radius > 1e-3 * depth:
            radius = depth
        scale = 1.0 / radius if radius > 0.0 and np.isfinite(radius) else 1.0
        return Normalization(scale, -scale * middle)

    def points(self, points: Float) -> Float:
        """Points [M,3] of the scene's world in the training world."""
        return np.asarray(points, np.float64) * self.scale + self.translation

    def camera(self, camera: Camera) -> Camera:
        """The camera in the training world; the picture it takes is the same, depths are `scale` times as large."""
        return camera.moved_to(self.scale * camera.center + self.translation)

    def undo_camera(self, camera: Camera) -> Camera:
        """The camera back in the scene's world."""
        return camera.moved_to((camera.center - self.translation) / self.scale)

    def apply(self, scene: Scene) -> Scene:
        """The scene in the training world."""
        views = tuple(replace(view, camera=self.camera(view.camera)) for view in scene.views)
        return replace(scene, views=views, points=self.points(scene.points))
