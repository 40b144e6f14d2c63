"""Whether a model can be trusted: its figures, photos whose pose is wrong, and the refusal of unusable ones."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from splatmill.schema.files.photos import MIN_PHOTOS
from splatmill_worker.colmap import pycolmap
from splatmill_worker.errors import SfmFailed
from splatmill_worker.sfm.cameras import FOCAL_BOUNDS, MIN_FISHEYE_FOCAL
from splatmill_worker.sfm.matching.pairs import Pair
from splatmill_worker.sfm.matching.two_view import MIN_INLIERS, ROTATION_CONFIGURATIONS, TwoView

MIN_SHARE = 0.3
"""Share of the photos that must be registered, in sets of more than SMALL_SET photos."""

SMALL_SET_SHARE = 0.5
"""Share of the photos that must be registered in smaller sets."""

SMALL_SET = 10
"""Largest number of photos of a small set."""

MIN_POINTS = 60
"""Least number of points of a usable model."""

MIN_TRIANGULATION_ANGLE = 1.5
"""Degrees: least median, over the points of a usable model, of the largest angle between two rays to the point."""

MIN_OBSERVED = 12
"""Points that a registered photo must observe; a pose from fewer may fit by chance."""

RELIABLE_OBSERVED = 40
"""Points that a photo must observe to count as reliably registered."""

RELIABLE_ERROR = 4.0
"""Pixels: largest mean reprojection error of a reliably registered photo."""

MAX_RELATIVE_ERROR = 3.0
"""Largest mean reprojection error of a photo, over the median of all photos."""

ALLOWED_ERROR = 2.5
"""Pixels: a mean reprojection error up to this is allowed whatever the median of all photos is."""

MAX_DISTORTION = 0.7
"""Largest absolute value of the first two distortion coefficients; a fisheye on a radial model stays below 0.5."""

ANGLE_SAMPLE = 1500
"""Points on which triangulation angles are measured, at least where there are that many."""

OVERLAP = (
    "Take photos that overlap more, so that each part of the scene is in at least three of them; keep the scene, its "
    "lighting and the zoom unchanged."
)
MOVE = (
    "Take a step between any two photos and walk around the scene; photos taken from one place hold no depth."
)


def min_registered(count: int) -> int:
    """Number of registered photos, of `count`, without which a model is refused."""
    share = SMALL_SET_SHARE if count <= SMALL_SET else MIN_SHARE
    return max(MIN_PHOTOS, math.ceil(share * count))


def implausible_intrinsics(model: pycolmap.Reconstruction) -> str | None:
    """A phrase for the first camera whose intrinsics no lens has; None when all are plausible."""
    for camera in model.cameras.values():
        if camera.is_spherical():
            continue
        focal = camera.mean_focal_length() / max(camera.width, camera.height)
        least = MIN_FISHEYE_FOCAL if camera.is_perspective_fisheye() else FOCAL_BOUNDS[0]
        if not least <= focal <= FOCAL_BOUNDS[1]:
            return f"a focal length of {focal:.2f} times the photo's longest side"
        extra = np.asarray(camera.params)[camera.extra_params_idxs()]
        if len(extra) and not np.all(np.abs(extra[:2]) <= MAX_DISTORTION):
            return f"radial distortion coefficients of {', '.join(f'{value:.2f}' for value in extra[:2])}"
    return None


def reprojection_errors(model: pycolmap.Reconstruction) -> dict[int, tuple[int, float]]:
    """Number of observed points and their mean reprojection error in pixels, by registered image id.

    The error is infinite for a photo without points, and where a point does not project.
    """
    result = {}
    for image_id, _, off in observations(model):
        error = np.linalg.norm(off, axis=1)
        mean = float(np.mean(error)) if len(error) and np.isfinite(error).all() else math.inf
        result[image_id] = len(error), mean
    return result


def observations(
    model: pycolmap.Reconstruction,
) -> Iterator[tuple[int, list[pycolmap.Point2D], npt.NDArray[np.float64]]]:
    """The id of each registered image, what it observes [n], and how far from there the model shows it, pixels [n, 2].

    Not finite where a point does not project, as behind a camera.
    """
    points = {point_id: point.xyz for point_id, point in model.points3D.items()}
    for image_id in model.reg_image_ids():
        image = model.images[image_id]
        observed = list(image.get_observation_points2D())
        world = np.array([points[point.point3D_id] for point in observed]).reshape(-1, 3)
        camera = model.cameras[image.camera_id]
        projected = np.asarray(camera.img_from_cam(image.cam_from_world() * world))
        off = projected - np.array([point.xy for point in observed]).reshape(-1, 2)
        if camera.is_spherical():  # whose left and right borders meet
            off[:, 0] -= camera.width * np.round(off[:, 0] / camera.width)
        yield image_id, observed, off


def reliably_registered(model: pycolmap.Reconstruction | None) -> set[int]:
    """Ids of the images that observe enough points with a small error; none when the intrinsics are implausible.

    Efforts and mappers are compared by the number of these images.
    """
    if model is None or implausible_intrinsics(model) is not None:
        return set()
    measured = reprojection_errors(model).items()
    return {
        image_id
        for image_id, (count, error) in measured
        if count >= RELIABLE_OBSERVED and error <= RELIABLE_ERROR
    }


def deregister_outliers(model: pycolmap.Reconstruction) -> dict[int, str]:
    """Deregister images whose pose cannot be right, in place; returns the reason for each, by image id."""
    measured = reprojection_errors(model)
    typical = float(np.median([error for _, error in measured.values()])) if measured else 0.0
    bound = max(ALLOWED_ERROR, MAX_RELATIVE_ERROR * typical)
    reasons = {}
    for image_id, (count, error) in measured.items():
        if count < MIN_OBSERVED:
            reasons[image_id] = (
                f"its pose was estimated from only {count} points, and at least {MIN_OBSERVED} are needed to trust it"
            )
        elif not error <= bound:
            reasons[image_id] = (
                f"its pose is wrong: a mean reprojection error of {error:.1f} pixels, where {typical:.1f} is usual"
            )
    for image_id in reasons:
        model.deregister_frame(model.images[image_id].frame_id)
    return reasons


def triangulation_angles(model: pycolmap.Reconstruction) -> npt.NDArray[np.float64]:
    """The largest angle between two rays to each point, or to each of a sample of the points, in degrees."""
    centers = {image_id: model.images[image_id].projection_center() for image_id in model.reg_image_ids()}
    points = list(model.points3D.values())
    angles = []
    for point in points[:: max(1, len(points) // ANGLE_SAMPLE)]:
        observers = [
            centers[element.image_id] for element in point.track.elements if element.image_id in centers
        ]
        if len(observers) < 2:
            continue
        rays = np.array(observers) - point.xyz
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        angles.append(math.degrees(math.acos(float(np.clip((rays @ rays.T).min(), -1.0, 1.0)))))
    return np.array(angles)


def pair_facts(matched: dict[Pair, TwoView]) -> dict[str, Any]:
    """Facts about the pairs, by name.

    pairs_matched: number of pairs that were matched.
    pairs_verified: number of those with at least MIN_INLIERS inliers.
    inliers_per_pair: median over the verified pairs.
    pairs_turned_only: number of verified pairs that a turning camera, or a flat scene, would explain.
    """
    verified = [pair for pair in matched.values() if pair.inliers >= MIN_INLIERS]
    kinds = Counter(pair.configuration for pair in verified)
    return {
        "pairs_matched": len(matched),
        "pairs_verified": len(verified),
        "inliers_per_pair": float(np.median([pair.inliers for pair in verified])) if verified else 0.0,
        "pairs_turned_only": sum(kinds[configuration] for configuration in ROTATION_CONFIGURATIONS),
    }


def model_facts(model: pycolmap.Reconstruction | None, photos: int) -> dict[str, Any]:
    """Facts about a model, by name; only the first three without a model.

    photos: number of photos, registered or not.
    registered: number of registered photos.
    points: number of points.
    track_length: mean number of observations of a point.
    reprojection_pixels: mean reprojection error, pixels.
    parallax_degrees: median over the points of the largest angle between two rays, degrees.
    """
    if model is None:
        return {"photos": photos, "registered": 0, "points": 0}
    angles = triangulation_angles(model)
    return {
        "photos": photos,
        "registered": model.num_reg_images(),
        "points": model.num_points3D(),
        "track_length": round(model.compute_mean_track_length(), 2),
        "reprojection_pixels": round(model.compute_mean_reprojection_error(), 3),
        "parallax_degrees": round(float(np.median(angles)), 2) if len(angles) else 0.0,
    }


def require_usable(facts: dict[str, Any]) -> None:
    """Raise SfmFailed when the facts about the model and its pairs are below what a scene can be trained on."""
    photos, registered = facts["photos"], facts["registered"]
    verified, turned = facts.get("pairs_verified", 0), facts.get("pairs_turned_only", 0)
    least = min_registered(photos)
    if registered < least or facts["points"] < MIN_POINTS:
        outcome = f"Only {registered} of {photos} photos could be placed, with {facts['points']} points"
        if verified >= max(1, photos // 3) and turned > 0.5 * verified:
            raise SfmFailed(
                "sfm_no_parallax",
                f"{outcome}: in {turned} of the {verified} pairs that match, the camera turned without moving, or saw "
                "a single flat surface.",
                facts,
                MOVE,
            )
        raise SfmFailed(
            "sfm_too_few_registered",
            f"{outcome}; at least {least} photos and {MIN_POINTS} points are needed. {verified} of "
            f"{facts.get('pairs_matched', 0)} pairs of photos match.",
            facts,
            OVERLAP,
        )
    if facts["parallax_degrees"] < MIN_TRIANGULATION_ANGLE:
        raise SfmFailed(
            "sfm_no_parallax",
            f"{registered} of {photos} photos could be placed, but the median triangulation angle of the points is "
            f"{facts['parallax_degrees']} degrees, and at least {MIN_TRIANGULATION_ANGLE} are needed: the camera "
            "turned and hardly moved.",
            facts,
            MOVE,
        )
