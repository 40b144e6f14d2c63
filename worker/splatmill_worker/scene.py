"""A scene: photos with cameras, sparse points, the held-out split, and the similarities between worlds.

Cameras follow OpenCV: x right, y down, z forward, world-to-camera matrices, and the centre of the first pixel at
(0.5, 0.5). All geometry is float64; `Normalization` brings it to a size at which float32 is accurate.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from splatmill.schema import ModelFrame

Float = npt.NDArray[np.float64]
Real = npt.NDArray[np.floating[Any]]
NAMED = 3
"""Files left out for one reason, up to which each has a sentence of its own."""

Source = Literal["sfm", "colmap", "transforms", "blender", "program"]
"""Where cameras come from: structure from motion, a COLMAP model, transforms.json, a Blender data set, or the file of
another program."""

MIN_DEPTH = 1e-9
"""Smallest depth, in world units, at which a point is projected; nearer ones and those behind the camera are not."""

WRONG_OUTLINES = 0.05
"""Share of the photos that show a place which may be wrong that it is transparent. Round a sphere, one photo in twenty
grazes the surface so closely that leaving it out enlarges the radius by a thousandth."""

MIN_SPREAD = 1e-3
"""Radius of the cameras over the median distance of the points, up to which the cameras count as one place."""


@dataclass(frozen=True)
class Lens:
    """The projection of a photo with lens distortion.

    model: COLMAP's name of the camera model.
    params: COLMAP's parameters of that model, lengths in pixels (OPENCV: fx, fy, cx, cy, k1, k2, p1, p2).
    width, height: size in pixels of the photo that the parameters refer to.
    limit: angle from the axis in radians up to which the photo shows something, where its picture is round.
    """

    model: str
    params: tuple[float, ...]
    width: int
    height: int
    limit: float = math.inf


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
        """The same camera for the photo resampled to `width` x `height` pixels."""
        x, y = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y
        )

    def cropped(self, left: int, top: int, width: int, height: int) -> Camera:
        """The same camera for `width` x `height` pixels of its photo, of which the first is at `left`, `top`."""
        return replace(self, width=width, height=height, cx=self.cx - left, cy=self.cy - top)


def viewmat_of(rotation: Float, center: Float) -> Float:
    """The world-to-camera matrix [4,4] of a camera with the world-to-camera `rotation` [3,3] at `center` [3]."""
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ center
    return viewmat


def looked_at(centers: Float, axes: Float, ridge: float = 1e-3, weights: Float | None = None) -> Float:
    """The point [3] with the least weighted sum of squared distances to all optical axes.

    centers, axes: positions and viewing directions [n,3] of the cameras; directions of any length.
    ridge: weight per camera of the squared distance to the cameras' mean position. Parallel axes leave the point
        undetermined; the ridge then keeps it near the cameras. With 0, parallel axes raise numpy's LinAlgError.
    weights: of the axes [n]; None: all 1.
    """
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    across = np.eye(3)[None] - axes[:, :, None] * axes[:, None, :]
    if weights is not None:
        across = across * weights[:, None, None]
    middle = centers.mean(axis=0)
    right = (across @ (centers - middle)[:, :, None]).sum(axis=0)[:, 0]
    target: Float = middle + np.linalg.solve(across.sum(axis=0) + ridge * len(centers) * np.eye(3), right)
    return target


@dataclass(frozen=True)
class Face:
    """The part of a panorama, or of a photo of a wide lens, that a view shows.

    photo: name of the photo.
    lens: projection of the photo.
    width, height: of the photo in pixels.
    rotation: from the photo's frame (x right, y down, z towards its middle) to the view's camera, [3,3].
    """

    photo: str
    lens: Lens
    width: int
    height: int
    rotation: Float


MIN_SHOWN = 128
"""Level of a mask, 0 to 255, from which a pixel is shown, unless all masks together are pictures of two labels."""


@dataclass(frozen=True)
class View:
    """One photo and its camera.

    name: of the photo, unique in its scene.
    camera: the pinhole camera of the undistorted photo at full size.
    image: path of the photo.
    mask: path of its mask, if there is one.
    lens: projection of the photo itself; None: that of `camera`.
    split: as given by a data set that brings its own; None: by the rule of `split`.
    upright: whether the camera describes the photo with its EXIF orientation applied.
    other: the view with the other `upright`, where the camera fits the photo both ways; None: it is decided.
    shown_from: level of the mask, 0 to 255, from which a pixel is shown.
    face: which part of the photo and of its mask the view shows, where several views share it; None: all of it.
    depth: path of its depth map, where the file with the cameras names one.
    """

    name: str
    camera: Camera
    image: Path
    mask: Path | None = None
    lens: Lens | None = None
    split: Literal["train", "test"] | None = None
    upright: bool = True
    other: View | None = None
    shown_from: int = MIN_SHOWN
    face: Face | None = None
    depth: Path | None = None

    @property
    def photo(self) -> str:
        """Name of the photo, which faces share."""
        return self.name if self.face is None else self.face.photo


class PointViews(NamedTuple):
    """Tracks of the points: point i is observed by the views with indices `views[offsets[i]:offsets[i + 1]]`."""

    offsets: npt.NDArray[np.int64]
    views: npt.NDArray[np.int32]


@dataclass(frozen=True)
class Overlay:
    """What never moves in the photos of one camera, as a logo, and is masked in all of them.

    photos: their names.
    caption: what it is, for the picture in the report.
    region: bool [h,w], at low resolution.
    """

    photos: tuple[str, ...]
    caption: str
    region: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Scene:
    """Posed photos and sparse points.

    views: the photos with their cameras.
    points: positions in the world, float64 [M,3].
    colors: RGB of the points, uint8 [M,3].
    source: where the cameras come from.
    point_errors: mean reprojection error of each point, in pixels of the photos [M]; None: not known.
    track_lengths: number of views that observe each point [M]; None: not known.
    point_views: the views that observe each point; None: not known.
    facts: figures about photos, pairs and model, by name.
    left_out: (name, reason) of each photo or file that is not used.
    notes: sentences for the user.
    warnings: sentences for the user about what is probably wrong.
    overlays: what is drawn over the photos, and masked.
    frame: how the world was chosen; None where it is that of given poses, or of a reconstruction as it came out.
    depth_unit: length in the world of one level of the depth maps, as the file with the cameras says; None: not stated.
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
    warnings: tuple[str, ...] = ()
    overlays: tuple[Overlay, ...] = ()
    frame: ModelFrame | None = None
    depth_unit: float | None = None

    @property
    def centers(self) -> Float:
        """The cameras' positions [views,3]."""
        return np.array([view.camera.center for view in self.views]).reshape(-1, 3)


def without(scene: Scene, indices: Collection[int], reason: str) -> Scene:
    """The scene without some views, whose photos are left out for `reason`; its points keep their other tracks."""
    if not indices:
        return scene
    kept = np.ones(len(scene.views), bool)
    kept[list(indices)] = False
    left_out = [(view.name, reason) for view, keep in zip(scene.views, kept, strict=True) if not keep]
    views = tuple(view for view, keep in zip(scene.views, kept, strict=True) if keep)
    scene = replace(scene, views=views, left_out=(*scene.left_out, *left_out))
    if scene.point_views is None:
        return scene
    offsets, observers = scene.point_views
    of_point = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))[kept[observers]]
    used, lengths = np.unique(of_point, return_counts=True)
    return replace(
        scene,
        points=scene.points[used],
        colors=scene.colors[used],
        point_errors=None if scene.point_errors is None else scene.point_errors[used],
        track_lengths=lengths.astype(np.int32),
        point_views=PointViews(
            np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
            (np.cumsum(kept) - 1)[observers[kept[observers]]].astype(np.int32),
        ),
    )


def omissions(left_out: Sequence[tuple[str, str]]) -> list[str]:
    """Sentences about files that are not used, given with the reasons: one for all files of a reason that are many."""
    names: dict[str, list[str]] = {}
    for name, reason in left_out:
        names.setdefault(reason.removesuffix("."), []).append(name)
    sentences = []
    for reason, files in names.items():
        if len(files) <= NAMED:
            sentences += [f"{name} is left out: {reason}." for name in files]
        else:
            sentences.append(f"{files[0]} and {len(files) - 1} more are left out: {reason}.")
    return sentences


def split(scene: Scene, holdout: int = 8) -> tuple[tuple[View, ...], tuple[View, ...]]:
    """Training views and held-out views.

    Where the data set names test views, those are held out. Else every `holdout`-th view in order of the names is held
    out, from the first one on; of fewer than three views, none is. With a `holdout` of 0 none is held out, and the test
    views of a data set are left out of both. Raises ValueError when `holdout` is negative, and when it would
    hold out every view.
    """
    views = sorted(scene.views, key=lambda view: view.name)
    if holdout < 0:
        raise ValueError(
            f"holdout is {holdout}; give 0 to hold out none, or 2 or more to hold out every n-th view."
        )
    own = [view for view in views if view.split == "test"]
    if own and holdout:
        return tuple(view for view in views if view.split != "test"), tuple(own)
    if holdout == 0 or len(views) < 3:
        return tuple(view for view in views if view.split != "test"), ()
    if holdout == 1:
        raise ValueError("holdout is 1, which holds out every view; give 2 or more, or 0 to hold out none.")
    test = tuple(views[::holdout])
    names = {view.name for view in test}
    return tuple(view for view in views if view.name not in names), test


@dataclass(frozen=True)
class Similarity:
    """The map x' = scale * rotation @ x + translation from one world to another, in float64.

    rotation: [3,3], with determinant 1.
    scale: above zero.
    translation: [3].
    """

    rotation: Float
    scale: float
    translation: Float

    @staticmethod
    def of(matrix: Real) -> Similarity:
        """The similarity with a matrix [4,4]."""
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        return Similarity(np.asarray(matrix[:3, :3] / scale, np.float64), scale, np.array(matrix[:3, 3]))

    @property
    def matrix(self) -> Float:
        """The matrix [4,4]."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.scale * self.rotation
        matrix[:3, 3] = self.translation
        return matrix

    def then(self, other: Similarity) -> Similarity:
        """This one, and `other` after it."""
        return Similarity(
            other.rotation @ self.rotation, other.scale * self.scale, other.points(self.translation)
        )

    def points(self, points: Float) -> Float:
        """Points [...,3] in the other world."""
        moved: Float = self.scale * (np.asarray(points, np.float64) @ self.rotation.T) + self.translation
        return moved

    def camera(self, camera: Camera) -> Camera:
        """The camera in the other world: its photo is the same, and depths are multiplied by `scale`."""
        rotation = camera.viewmat[:3, :3] @ self.rotation.T
        return replace(camera, viewmat=viewmat_of(rotation, self.points(camera.center)))

    def apply(self, scene: Scene) -> Scene:
        """The scene in the other world."""
        views = tuple(replace(view, camera=self.camera(view.camera)) for view in scene.views)
        return replace(scene, views=views, points=self.points(scene.points))


@dataclass(frozen=True)
class Normalization:
    """The similarity x' = scale * x + translation from the scene's world to the training world.

    It is float64: in float32, neighbouring numbers near a northing of 5e6 metres are 0.5 metres apart.
    """

    scale: float
    translation: Float

    @staticmethod
    def of(scene: Scene) -> Normalization:
        """The similarity that puts the cameras' mean at the origin and the farthest camera at distance 1.

        When the cameras are in one place (a single view, a turning tripod), the median distance of the points becomes
        1 instead; without points the scale is 1.
        """
        centers = scene.centers
        middle = centers.mean(axis=0) if len(centers) else np.zeros(3)
        radius = float(np.linalg.norm(centers - middle, axis=1).max(initial=0.0))
        depth = float(np.median(np.linalg.norm(scene.points - middle, axis=1))) if len(scene.points) else 0.0
        if not radius > MIN_SPREAD * depth:
            radius = depth
        scale = 1.0 / radius if radius > 0.0 and np.isfinite(radius) else 1.0
        return Normalization(scale, -scale * middle)

    def points(self, points: Float) -> Float:
        """Points [M,3] of the scene's world, in the training world."""
        return np.asarray(points, np.float64) * self.scale + self.translation

    def camera(self, camera: Camera) -> Camera:
        """The camera in the training world: its photo is the same, and depths are multiplied by `scale`."""
        return camera.moved_to(self.scale * camera.center + self.translation)

    def undo_camera(self, camera: Camera) -> Camera:
        """The camera back in the scene's world."""
        return camera.moved_to((camera.center - self.translation) / self.scale)

    def apply(self, scene: Scene) -> Scene:
        """The scene in the training world."""
        views = tuple(replace(view, camera=self.camera(view.camera)) for view in scene.views)
        return replace(scene, views=views, points=self.points(scene.points))
