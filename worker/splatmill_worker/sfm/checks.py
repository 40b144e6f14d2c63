"""What came out, in figures, and whether it can be trusted."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import numpy as np
import numpy.typing as npt

from splatmill_worker.colmap import pycolmap
from splatmill_worker.errors import SfmFailed
from splatmill_worker.sfm.cameras import FOCAL_BOUNDS
from splatmill_worker.sfm.geometry import MIN_INLIERS, TURNED_ONLY, Verified
from splatmill_worker.sfm.pairs import Pair

MIN_SHARE = 0.3  # of the photos, in sets of more than ten; half of them in smaller ones
MIN_REGISTERED = 3
MIN_POINTS = 60
MIN_PARALLAX = 1.5  # degrees, median over points of the largest angle between two of their rays
MIN_SEEN = 12  # points: a photo placed on fewer hangs on chance
SURE_SEEN = 40  # points from which on a photo counts as placed when efforts and mappers are compared
SURE_PIXELS = 4.0
MAX_RESIDUAL = 3.0  # times the median photo's mean reprojection error, and at least WORST_PIXELS
WORST_PIXELS = 2.5
MAX_DISTORTION = 0.7  # of the first radial coefficient; a fisheye on a radial model stays under 0.5
ANGLE_SAMPLE = 1500  # points on which parallax is measured

OVERLAP = "The photos share too little: take them with more overlap, so that each thing is in at least three photos."
MOVE = "Walk around the scene while taking the photos, a step between any two; turning on the spot shows no depth."


def floor(count: int) -> int:
    """Photos that have to be registered for a model to be worth training."""
    return max(MIN_REGISTERED, math.ceil(0.5 * count) if count <= 10 else math.ceil(MIN_SHARE * count))


def absurd_intrinsics(model: pycolmap.Reconstruction) -> str | None:
    """What about the cameras no lens can be, in words; None where all could be."""
    for camera in model.cameras.values():
        focal = camera.mean_focal_length() / max(camera.width, camera.height)
        if not FOCAL_BOUNDS[0] <= focal <= FOCAL_BOUNDS[1]:
            return f"a focal length of {focal:.2f} times the photo's longest side"
        extra = np.asarray(camera.params)[camera.extra_params_idxs()]
        if len(extra) and not np.all(np.abs(extra[:2]) <= MAX_DISTORTION):
            return f"a radial distortion of {', '.join(f'{value:.2f}' for value in extra[:2])}"
    return None


def residuals(model: pycolmap.Reconstruction) -> dict[int, tuple[int, float]]:
    """For each registered image its number of points and their mean reprojection error in pixels."""
    points = {point_id: point.xyz for point_id, point in model.points3D.items()}
    result = {}
    for image_id in model.reg_image_ids():
        image = model.images[image_id]
        seen = [point for point in image.points2D if point.has_point3D()]
        if not seen:
            result[image_id] = 0, math.inf
            continue
        world = np.array([points[point.point3D_id] for point in seen])
        projected = np.asarray(model.cameras[image.camera_id].img_from_cam(image.cam_from_world() * world))
        error = np.linalg.norm(projected - np.array([point.xy for point in seen]), axis=1)
        result[image_id] = len(seen), float(np.mean(error)) if np.isfinite(error).all() else math.inf
    return result


def trusted(model: pycolmap.Reconstruction | None) -> int:
    """How many photos of a model hang on enough points to believe in it; 0 where its cameras are none."""
    return len(trusted_images(model))


def trusted_images(model: pycolmap.Reconstruction | None) -> set[int]:
    """The ids of those photos."""
    if model is None or absurd_intrinsics(model) is not None:
        return set()
    measured = residuals(model).items()
    return {image_id for image_id, (count, error) in measured if count >= SURE_SEEN and error <= SURE_PIXELS}


def drop_misplaced(model: pycolmap.Reconstruction) -> dict[int, str]:
    """Takes photos out that cannot stand where they were put, and says why, by image id."""
    measured = residuals(model)
    typical = float(np.median([error for _, error in measured.values()])) if measured else 0.0
    bound = max(WORST_PIXELS, MAX_RESIDUAL * typical)
    reasons = {}
    for image_id, (count, error) in measured.items():
        if count < MIN_SEEN:
            reasons[image_id] = f"it was placed on only {count} points, too few to trust"
        elif not error <= bound:
            reasons[image_id] = (
                f"its points miss by {error:.1f} pixels where {typical:.1f} is usual: placed wrongly"
            )
    for image_id in reasons:
        model.deregister_frame(model.images[image_id].frame_id)
    return reasons


def parallax(model: pycolmap.Reconstruction) -> npt.NDArray[np.float64]:
    """The largest angle between two rays of each of (a sample of) the points, in degrees."""
    centers = {image_id: model.images[image_id].projection_center() for image_id in model.reg_image_ids()}
    points = list(model.points3D.values())
    angles = []
    for point in points[:: max(1, len(points) // ANGLE_SAMPLE)]:
        seen = [centers[element.image_id] for element in point.track.elements if element.image_id in centers]
        if len(seen) < 2:
            continue
        rays = np.array(seen) - point.xyz
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        angles.append(math.degrees(math.acos(float(np.clip((rays @ rays.T).min(), -1.0, 1.0)))))
    return np.array(angles)


def pair_facts(verified: dict[Pair, Verified]) -> dict[str, Any]:
    """Pairs matched, pairs that hold, their median inliers, and the share that a turning camera would explain."""
    good = [pair for pair in verified.values() if pair.inliers >= MIN_INLIERS]
    kinds = Counter(pair.config for pair in good)
    return {
        "pairs_matched": len(verified),
        "pairs_verified": len(good),
        "inliers_per_pair": float(np.median([pair.inliers for pair in good])) if good else 0.0,
        "pairs_turned_only": sum(kinds[config] for config in TURNED_ONLY),
    }


def model_facts(model: pycolmap.Reconstruction | None, photos: int) -> dict[str, Any]:
    """Registered share, points, track length, reprojection error and parallax of a model."""
    if model is None:
        return {"photos": photos, "registered": 0, "points": 0}
    angles = parallax(model)
    return {
        "photos": photos,
        "registered": model.num_reg_images(),
        "points": model.num_points3D(),
        "track_length": round(model.compute_mean_track_length(), 2),
        "reprojection_pixels": round(model.compute_mean_reprojection_error(), 3),
        "parallax_degrees": round(float(np.median(angles)), 2) if len(angles) else 0.0,
    }


def require_usable(facts: dict[str, Any]) -> None:
    """Raises SfmFailed where the figures are below what a scene can be trained on."""
    photos, registered = facts["photos"], facts["registered"]
    verified, turned = facts.get("pairs_verified", 0), facts.get("pairs_turned_only", 0)
    if registered < floor(photos) or facts["points"] < MIN_POINTS:
        if verified >= max(1, photos // 3) and turned > 0.5 * verified:
            raise SfmFailed(
                "sfm_no_parallax",
                f"Registered {registered} of {photos} images: in {turned} of the {verified} pairs that match, the "
                "camera turned but did not move (or saw one flat surface only).",
                facts,
                MOVE,
            )
        raise SfmFailed(
            "sfm_too_few_registered",
            f"Registered {registered} of {photos} images ({verified} of {facts.get('pairs_matched', 0)} pairs match, "
            f"{facts['points']} points); at least {floor(photos)} are needed.",
            facts,
            OVERLAP,
        )
    if facts["parallax_degrees"] < MIN_PARALLAX:
        raise SfmFailed(
            "sfm_no_parallax",
            f"Registered {registered} of {photos} images, but half of the points are seen under less than "
            f"{facts['parallax_degrees']} degrees: the camera turned and hardly moved.",
            facts,
            MOVE,
        )
