"""How far a model agrees with the matches of a pair of photos."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from splatmill_worker.colmap import pycolmap
from splatmill_worker.sfm import features
from splatmill_worker.sfm.matching import two_view
from splatmill_worker.sfm.matching.pairs import Pair
from splatmill_worker.sfm.run import EffortResult

Float = npt.NDArray[np.float64]


class Poses:
    """The poses of a model's photos, by their indices."""

    def __init__(self, model: pycolmap.Reconstruction) -> None:
        self.model = model
        self._images = {
            features.photo_index(model.images[number].name): model.images[number]
            for number in model.reg_image_ids()
        }

    @property
    def photos(self) -> set[int]:
        """Indices of the registered photos."""
        return set(self._images)

    def have(self, pair: Pair) -> bool:
        """Whether both photos are registered."""
        return pair[0] in self._images and pair[1] in self._images

    def camera(self, photo: int) -> pycolmap.Camera:
        """The camera of a registered photo."""
        return self.model.cameras[self._images[photo].camera_id]

    def center(self, photo: int) -> Float:
        """Where a registered photo was taken [3], in the model's world."""
        return np.asarray(self._images[photo].projection_center())

    def between(self, pair: Pair) -> tuple[Float, Float]:
        """Rotation [3,3] and translation [3] from the camera of the first photo to that of the second."""
        first, second = (self._images[photo].cam_from_world() for photo in pair)
        second_from_first = second * first.inverse()
        return np.asarray(second_from_first.rotation.matrix()), np.asarray(second_from_first.translation)


def agreement(poses: Poses, result: EffortResult, database: pycolmap.Database, pair: Pair) -> float:
    """Share of the pair's inliers that fit the epipolar geometry of the model's two cameras.

    A match fits where its Sampson error is at most the bound of verification: Hartley and Zisserman, "Multiple
    View Geometry in Computer Vision", second edition, section 11.4.3. Both photos must be registered.
    """
    first, second = pair
    matches = np.asarray(
        database.read_two_view_geometry(result.ids[first], result.ids[second]).inlier_matches
    )
    cameras = poses.camera(first), poses.camera(second)
    a, b = (
        np.asarray(camera.cam_from_img(result.features[photo].points[column]), np.float64)
        for camera, photo, column in zip(cameras, pair, matches.T, strict=True)
    )
    rotation, translation = poses.between(pair)
    x, y, z = translation
    essential = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ rotation
    ones = np.ones((len(matches), 1))
    a, b = np.hstack([a, ones]), np.hstack([b, ones])
    in_second, in_first = a @ essential.T, b @ essential  # epipolar lines
    slope = np.hypot(np.linalg.norm(in_second[:, :2], axis=1), np.linalg.norm(in_first[:, :2], axis=1))
    focal = (cameras[0].mean_focal_length() + cameras[1].mean_focal_length()) / 2.0
    allowed = two_view.max_error(max(max(camera.width, camera.height) for camera in cameras)) / focal
    return float(np.mean(np.abs((b * in_second).sum(axis=1)) <= allowed * slope))
