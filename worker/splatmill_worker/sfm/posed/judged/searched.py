"""Features of photos with given cameras, COLMAP's model and database of them, and how well cameras explain matches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatmill_worker.colmap import pycolmap
from splatmill_worker.images.load import Photo, load_view, training_size
from splatmill_worker.scene import Camera, View
from splatmill_worker.sfm import sift
from splatmill_worker.sfm.callbacks import OnProgress, stop_if
from splatmill_worker.sfm.matching import pairs
from splatmill_worker.sfm.options import Effort
from splatmill_worker.sfm.sift import Features

Float = npt.NDArray[np.float64]

GREY = (0.5, 0.5, 0.5)
"""RGB behind transparent photos: the outline of the object then has less contrast than over black or white."""

OPAQUE = 250
"""Alpha (0 to 255) from which a feature counts: on the outline of an object it lies at no fixed place."""


SAME_PLACE = 1e-9
"""Distance between two cameras, over that from the origin, below which they are in one place."""


@dataclass(frozen=True)
class Searched:
    """A photo's features, their colours [n,3], the pinhole camera at the size of the search, and its transparency."""

    camera: Camera
    features: Features
    colors: npt.NDArray[np.uint8]
    transparent: bool


def features_of(
    views: Sequence[View],
    effort: Effort,
    pool: ThreadPoolExecutor,
    on_progress: OnProgress,
    cancelled: Callable[[], bool],
) -> list[Searched]:
    """The features of every photo that lie on unmasked, opaque pixels. Raises Cancelled between two photos."""
    slots = sift.search_slots(
        training_size(view.camera.width, view.camera.height, effort.side) for view in views
    )

    def search_view(view: View) -> Searched:
        with slots:
            stop_if(cancelled)
            return _searched(load_view(view, effort.side, background=GREY), effort)

    photos = []
    for each in pool.map(search_view, views):
        photos.append(each)
        on_progress("features", len(photos), len(views), views[len(photos) - 1].name)
    return photos


def _searched(photo: Photo, effort: Effort) -> Searched:
    luma = (photo.rgb @ np.array([0.299, 0.587, 0.114]) + 0.5).astype(np.uint8)
    shown = np.full(luma.shape, 255, np.uint8)
    if photo.mask is not None:
        shown[~photo.mask] = 0
    if photo.alpha is not None:
        shown[photo.alpha < OPAQUE] = 0
    mask = None if shown.all() else shown
    # A place with several orientations would be several observations of one point.
    features = sift.find(luma, mask, effort.features, one_orientation=True)
    column, row = features.points.astype(np.int64).T
    return Searched(
        photo.camera,
        features,
        photo.rgb[row, column],
        photo.alpha is not None and bool((photo.alpha < 255).any()),
    )


def model_of(cameras: Sequence[Camera]) -> pycolmap.Reconstruction:
    """COLMAP's model of the cameras, without points; view i has the camera, the image and the frame i + 1."""
    model = pycolmap.Reconstruction()
    for number, camera in enumerate(cameras, 1):
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(
                model="PINHOLE",
                width=camera.width,
                height=camera.height,
                params=[camera.fx, camera.fy, camera.cx, camera.cy],
                camera_id=number,
            )
        )
        model.add_image_with_trivial_frame(
            pycolmap.Image(name=f"{number:06d}", camera_id=number, image_id=number),
            pycolmap.Rigid3d(camera.viewmat[:3]),
        )
    return model


def database_of(
    path: Path, model: pycolmap.Reconstruction, features: Sequence[Features]
) -> pycolmap.Database:
    """A database of the model's cameras and images, and of the features."""
    database = pycolmap.Database.open(path)
    for number, each in enumerate(features, 1):
        database.write_camera(model.cameras[number], use_camera_id=True)
        database.write_rig(model.rigs[number], use_rig_id=True)
        database.write_frame(model.frames[number], use_frame_id=True)
        database.write_image(model.images[number], use_image_id=True)
        database.write_keypoints(number, each.points.astype(np.float32))
    return database


def epipolar_errors(
    verified: Sequence[pairs.Pair],
    cameras: Sequence[Camera],
    features: Sequence[Features],
    database: pycolmap.Database,
    *,
    in_front: bool = False,
) -> Float:
    """Sampson errors, in pixels of the searched photos, of all verified matches under the given cameras [n].

    Cameras in one place have no epipolar lines: the error is the distance to the pixel that the turn leads to.

    in_front: make the error of a match infinite where its rays do not meet in front of both cameras.

    Hartley and Zisserman, "Multiple View Geometry", 2nd edition, equation 11.9.
    """
    errors = [np.zeros(0)]
    for first, second in verified:
        matches = database.read_two_view_geometry(first + 1, second + 1).inlier_matches
        a, b = cameras[first], cameras[second]
        motion = b.viewmat @ np.linalg.inv(a.viewmat)
        x, y, z = motion[:3, 3]
        essential = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ motion[:3, :3]
        fundamental = np.linalg.inv(b.K).T @ essential @ np.linalg.inv(a.K)
        ones = np.ones((len(matches), 1))
        left = np.hstack([features[first].points[matches[:, 0]], ones])
        right = np.hstack([features[second].points[matches[:, 1]], ones])
        line, back = left @ fundamental.T, right @ fundamental
        across = (line[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1)
        error = np.abs((right * line).sum(axis=1)) / np.sqrt(np.maximum(across, 1e-300))
        if np.linalg.norm(motion[:3, 3]) <= SAME_PLACE * (1.0 + np.linalg.norm(a.center)):
            turned = left @ (b.K @ motion[:3, :3] @ np.linalg.inv(a.K)).T
            error = np.linalg.norm(turned[:, :2] / turned[:, 2:] - right[:, :2], axis=1)
        errors.append(np.where(_meet_in_front(a, b, left, right), error, np.inf) if in_front else error)
    return np.concatenate(errors)


def _meet_in_front(a: Camera, b: Camera, left: Float, right: Float) -> npt.NDArray[np.bool_]:
    """Whether the rays of two cameras through homogeneous pixels [n,3] are nearest to each other in front of both."""
    one = left @ (np.linalg.inv(a.K).T @ a.viewmat[:3, :3])
    two = right @ (np.linalg.inv(b.K).T @ b.viewmat[:3, :3])
    apart = b.center - a.center
    across = (one * two).sum(axis=1)
    first, second = (one**2).sum(axis=1), (two**2).sum(axis=1)
    # The least squares solution of s * one - t * two = apart, times its determinant, which is not negative.
    s = second * (one @ apart) - across * (two @ apart)
    t = across * (one @ apart) - first * (two @ apart)
    front: npt.NDArray[np.bool_] = (s > 0.0) & (t > 0.0)
    return front
