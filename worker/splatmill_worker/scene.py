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
Source = Literal["sfm", "colmap", "transforms", "blender"]


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


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: size and intrinsics in pixels, and the rigid world-to-camera matrix [4,4]."""

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

    def scaled_to(self, width: int, height: int) -> Camera:
        """The same camera for a photo resampled to `width` x `height` pixels."""
        x, y = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y
        )


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

    def undo_points(self, points: Float) -> Float:
        """Points [M,3] of the training world back in the scene's world."""
        return (np.asarray(points, np.float64) - self.translation) / self.scale

    def camera(self, camera: Camera) -> Camera:
        """The camera in the training world; the picture it takes is the same, depths are `scale` times as large."""
        viewmat = camera.viewmat.copy()
        viewmat[:3, 3] = -viewmat[:3, :3] @ (self.scale * camera.center + self.translation)
        return replace(camera, viewmat=viewmat)

    def undo_camera(self, camera: Camera) -> Camera:
        """The camera back in the scene's world."""
        viewmat = camera.viewmat.copy()
        viewmat[:3, 3] = -viewmat[:3, :3] @ ((camera.center - self.translation) / self.scale)
        return replace(camera, viewmat=viewmat)

    def apply(self, scene: Scene) -> Scene:
        """The scene in the training world."""
        views = tuple(replace(view, camera=self.camera(view.camera)) for view in scene.views)
        return replace(scene, views=views, points=self.points(scene.points))
