"""Divides a camera whose photos have two focal lengths, although neither EXIF nor folders say so."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from splatmill_worker.colmap import pycolmap
from splatmill_worker.sfm.cameras import CameraGroup
from splatmill_worker.sfm.checks import RELIABLE_OBSERVED
from splatmill_worker.sfm.features import photo_index
from splatmill_worker.sfm.mapping.adjust import Deviations, bundle_adjust, median_error
from splatmill_worker.sfm.mapping.registered import registered

LEAST_STEP = 0.01
"""Distance of two clusters of `focal_steps` from which two cameras are tried: poses and points hide most of the
difference of two focal lengths (decisions: LEAST_STEP)."""

LEAST_DIFFERENCE = 0.04
"""Logarithmic difference of two adjusted focal lengths from which they are of two cameras (decisions: LEAST_STEP)."""

LEAST_DEVIATIONS = 5.0
"""The same in standard deviations of the adjustment."""

LEAST_GAIN = 0.1
"""Share of the reprojection error that two cameras remove, at least: one lens for two is wrong for all of its photos,
while a camera more always removes a little (decisions: LEAST_STEP)."""

ROUNDS = 3
"""Adjustments with two cameras, at most; after each, photos change to the camera whose focal length is nearer."""

LEAST_PHOTOS = 3
"""Photos of each of the two focal lengths, at least."""


def divided(
    groups: Sequence[CameraGroup],
    model: pycolmap.Reconstruction,
    threads: int = 1,
    cancelled: Callable[[], bool] = lambda: False,
) -> list[CameraGroup]:
    """`groups`, with two cameras for one where the photos of `model` have two focal lengths.

    Where the `focal_steps` of a camera form two clusters, the model is adjusted with a camera for each of them, and the
    camera is divided if their focal lengths differ. Photos that are not in the model stay with the first of the two.
    """
    steps = focal_steps(model)
    result: list[CameraGroup] = []
    for group in groups:
        own = {photo: steps[photo] for photo in group.photos if photo in steps}
        second = _second_cluster(own) if not group.known else frozenset()
        if second:
            second = _second_lens(model, own.keys(), second, threads, cancelled)
        if not second:
            result.append(group)
            continue
        first = tuple(photo for photo in group.photos if photo not in second)
        result += [replace(group, photos=first), replace(group, photos=tuple(sorted(second)))]
    return result


def focal_steps(model: pycolmap.Reconstruction) -> dict[int, float]:
    """The logarithm of each photo's own focal length over that of its camera, to first order, by the photo's index.

    Photos that observe fewer than RELIABLE_OBSERVED points are left out.
    """
    points = {point_id: point.xyz for point_id, point in model.points3D.items()}
    steps = {}
    for image_id in model.reg_image_ids():
        image = model.images[image_id]
        observed = image.get_observation_points2D()
        if len(observed) < RELIABLE_OBSERVED or model.cameras[image.camera_id].is_spherical():
            continue
        local = image.cam_from_world() * np.array([points[point.point3D_id] for point in observed])
        pixels = np.array([point.xy for point in observed])
        step = _focal_step(model.cameras[image.camera_id], local, pixels)
        if step is not None:
            steps[photo_index(image.name)] = step
    return steps


def _focal_step(
    camera: pycolmap.Camera, local: npt.NDArray[np.float64], pixels: npt.NDArray[np.float64]
) -> float | None:
    """The step for points [n,3] in the camera's frame, observed at `pixels` [n,2]; None where it is undefined."""
    x, y, z = local.T
    projected = np.asarray(camera.img_from_cam(local))
    residuals = pixels - projected
    if not np.isfinite(residuals).all() or not (z > 0).all():
        return None
    focal, zero, one = camera.mean_focal_length(), np.zeros_like(z), np.ones_like(z)
    # Of pixels to points, and of points to a rotation and a translation of the camera.
    by_point = focal * np.stack([one / z, zero, -x / z**2, zero, one / z, -y / z**2], 1).reshape(-1, 2, 3)
    by_turn = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], 1).reshape(-1, 3, 3)
    by_focal = projected - [camera.principal_point_x, camera.principal_point_y]
    jacobian = np.concatenate([by_point @ by_turn, by_point, by_focal[:, :, None]], axis=2)
    weights = 1 / np.sqrt(1 + (residuals**2).sum(1))
    normal = np.einsum("nij,nik,n->jk", jacobian, jacobian, weights)
    right = np.einsum("nij,ni,n->j", jacobian, residuals, weights)
    try:
        return float(np.linalg.solve(normal, right)[-1])
    except np.linalg.LinAlgError:
        return None


def _second_cluster(steps: Mapping[int, float]) -> frozenset[int]:
    """The photos of the smaller of two clusters of steps; empty where the steps are too close together."""
    order = sorted(steps, key=lambda photo: steps[photo])
    values = np.array([steps[photo] for photo in order])
    best, cut = 0.0, 0
    for count in range(LEAST_PHOTOS, len(values) - LEAST_PHOTOS + 1):
        low, high = values[:count], values[count:]
        between = count * len(high) * (high.mean() - low.mean()) ** 2
        if between > best:
            best, cut = between, count
    if not cut or np.median(values[cut:]) - np.median(values[:cut]) < LEAST_STEP:
        return frozenset()
    return frozenset(order[:cut] if 2 * cut < len(order) else order[cut:])


def _second_lens(
    model: pycolmap.Reconstruction,
    photos: Collection[int],
    second: frozenset[int],
    threads: int,
    cancelled: Callable[[], bool],
) -> frozenset[int]:
    """Those of `photos` that have another focal length than the rest, to begin with `second`; empty where none have."""
    photo_of = {image_id: photo_index(model.images[image_id].name) for image_id in model.reg_image_ids()}
    old_id = next(model.images[image_id].camera_id for image_id, photo in photo_of.items() if photo in second)
    new_id = max(model.cameras) + 1
    model.update_point_3d_errors()
    single = median_error(model)
    for _ in range(ROUNDS):
        images = {image_id for image_id, photo in photo_of.items() if photo in second}
        trial = registered(model, new_id, images)
        bundle_adjust(trial, threads, cancelled=cancelled)
        deviations = Deviations(trial)
        cameras = old_id, new_id
        focals = [math.log(trial.cameras[camera].mean_focal_length()) for camera in cameras]
        uncertainty = math.hypot(*(deviations.focal(camera) for camera in cameras))
        differ = abs(focals[1] - focals[0]) >= max(LEAST_DIFFERENCE, LEAST_DEVIATIONS * uncertainty)
        if not differ or not deviations.error <= (1 - LEAST_GAIN) * single:
            return frozenset()
        own = {photo: focals[photo in second] + step for photo, step in focal_steps(trial).items()}
        nearer = frozenset(
            photo
            for photo in photos
            if (
                abs(own[photo] - focals[1]) < abs(own[photo] - focals[0]) if photo in own else photo in second
            )
        )
        if nearer == second or not LEAST_PHOTOS <= len(nearer) <= len(photos) - LEAST_PHOTOS:
            break
        second = nearer
    return second
