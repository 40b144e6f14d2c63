"""The observations that place cameras best, which are those of small features.

The position of a feature is less certain the larger it is, and the error of a large one is more than noise: where a
surface is seen obliquely, the middle of what a large feature shows is not where it looks to be. An adjustment weighs
all observations alike. In a wide scene of many photos the large ones bend the lens, and with it the whole scene.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatmill_worker.colmap import pycolmap
from splatmill_worker.sfm.checks import observations

KEPT_OBSERVATIONS = 100
"""Observations of a photo that are kept, those of its smallest features, however large these are (decisions:
KEPT_OBSERVATIONS)."""

Scales = Mapping[int, npt.NDArray[np.float32]]
"""Scales [n] in pixels of the features of each registered photo, by its image's id, in the order of its points."""


def without_large_features(model: pycolmap.Reconstruction, scales: Scales) -> pycolmap.Reconstruction | None:
    """A copy with the observations of features up to the scale that makes the estimate of the cameras most precise.

    Of n observations with a mean squared error v, the variance of what is estimated is proportional to v / n. Errors
    are those of the model as it is. A photo keeps its KEPT_OBSERVATIONS smallest ones, with all others of a point where
    nothing else of it would be left.

    model: with registered photos; it is not changed.

    None where all observations are kept.
    """
    measurements = _Observations.of(model, scales)
    if measurements is None:
        return None
    first = measurements.rank_in_photo() < KEPT_OBSERVATIONS
    others = np.flatnonzero(~first)
    others = others[np.argsort(measurements.scale[others], kind="stable")]
    errors = measurements.error[first].sum() + np.concatenate([[0.0], np.cumsum(measurements.error[others])])
    count = int(np.argmin(errors / (first.sum() + np.arange(len(others) + 1)) ** 2))
    limit = measurements.scale[others[count - 1]] if count else -np.inf
    kept = first | (measurements.scale <= limit)
    of_point = np.bincount(measurements.point, kept)
    alone = np.unique(measurements.point[first & (of_point[measurements.point] == 1)])
    kept |= np.isin(measurements.point, alone)
    if kept.all():
        return None
    result = copy.deepcopy(model)
    for image_id, number in zip(
        measurements.photo[~kept].tolist(), measurements.number[~kept].tolist(), strict=True
    ):
        if result.images[image_id].points2D[number].has_point3D():
            result.delete_observation(image_id, number)
    result.update_point_3d_errors()
    return result


def take_cameras(model: pycolmap.Reconstruction, adjusted: pycolmap.Reconstruction) -> None:
    """Give `model`, in place, the lenses, poses and points of a copy without some of its observations.

    Points that the copy does not have move with the photos that observe them.
    """
    before = {image_id: model.images[image_id].cam_from_world() for image_id in adjusted.reg_image_ids()}
    for camera_id, camera in adjusted.cameras.items():
        model.cameras[camera_id].model, model.cameras[camera_id].params = camera.model, camera.params
    for image_id in adjusted.reg_image_ids():
        image = model.images[image_id]
        model.frames[image.frame_id].rig_from_world = adjusted.images[image_id].cam_from_world()
    for point_id, point in adjusted.points3D.items():
        model.points3D[point_id].xyz = point.xyz
    motions = {
        image_id: (model.images[image_id].cam_from_world().inverse() * pose).matrix()
        for image_id, pose in before.items()
    }
    for point_id in set(model.points3D.keys()).difference(adjusted.points3D.keys()):
        point = model.points3D[point_id]
        motion = np.mean([motions[each.image_id] for each in point.track.elements], axis=0)
        point.xyz = motion[:, :3] @ point.xyz + motion[:, 3]


@dataclass(frozen=True)
class _Observations:
    """All n observations of a model.

    photo: id of the image [n].
    number: of the feature in its photo [n].
    point: id of the point [n].
    scale: of the feature [n], in pixels.
    error: squared distance from where the model shows the point [n], in pixels, as the loss of the adjustment counts
        it; zero behind the camera, where the solver counts nothing.
    """

    photo: npt.NDArray[np.int64]
    number: npt.NDArray[np.int64]
    point: npt.NDArray[np.int64]
    scale: npt.NDArray[np.float32]
    error: npt.NDArray[np.float64]

    @classmethod
    def of(cls, model: pycolmap.Reconstruction, scales: Scales) -> _Observations | None:
        """Those of the registered photos; None where there are none."""
        columns = []
        for image_id, observed, off in observations(model):
            numbers = np.array(model.images[image_id].get_observation_point2D_idxs(), np.int64)
            points = np.array([point.point3D_id for point in observed], np.int64)
            squared = np.nan_to_num((off**2).sum(axis=1))
            loss = 2.0 * (np.sqrt(1.0 + squared) - 1.0)
            columns.append(
                (np.full(len(numbers), image_id), numbers, points, scales[image_id][numbers], loss)
            )
        if not sum(len(numbers) for _, numbers, *_ in columns):
            return None
        return cls(*(np.concatenate(each) for each in zip(*columns, strict=True)))

    def rank_in_photo(self) -> npt.NDArray[np.int64]:
        """How many smaller features the same photo observes [n]; of equal ones the order counts."""
        order = np.lexsort((self.scale, self.photo))
        rank = np.empty(len(order), np.int64)
        rank[order] = np.arange(len(order)) - np.searchsorted(self.photo[order], self.photo[order])
        return rank
