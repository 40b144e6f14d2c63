"""The last bundle adjustment of a model, with a full lens model for cameras that the photos determine well."""

from __future__ import annotations

from collections.abc import Callable

from splatmill_worker.colmap import pycolmap
from splatmill_worker.sfm.callbacks import stop_if

OPENCV_MIN_PHOTOS = 8
"""Registered photos of a camera from which its four OPENCV distortion coefficients are estimated."""

OPENCV_MIN_OBSERVATIONS = 2000
"""Observations of points by a camera from which its four OPENCV distortion coefficients are estimated."""

MAX_ITERATIONS = 50
"""Iterations of the last bundle adjustment, at most."""

FUNCTION_TOLERANCE = 1e-6
"""Relative decrease of the cost below which the last bundle adjustment has converged."""


def use_opencv_cameras(model: pycolmap.Reconstruction) -> bool:
    """Turn well-determined SIMPLE_RADIAL cameras into OPENCV ones (k1, k2, p1, p2), in place.

    Returns whether any camera was changed. Mapping estimates a single radial coefficient, which a few photos
    determine; the last bundle adjustment then estimates the whole lens (decisions: OPENCV_CAMERAS).
    """
    photos: dict[int, int] = {}
    observations: dict[int, int] = {}
    for image_id in model.reg_image_ids():
        image = model.images[image_id]
        photos[image.camera_id] = photos.get(image.camera_id, 0) + 1
        observations[image.camera_id] = observations.get(image.camera_id, 0) + image.num_points3D
    changed = False
    for camera_id, camera in model.cameras.items():
        determined = (
            photos.get(camera_id, 0) >= OPENCV_MIN_PHOTOS
            and observations[camera_id] >= OPENCV_MIN_OBSERVATIONS
        )
        if determined and camera.model == pycolmap.CameraModelId.SIMPLE_RADIAL:
            focal, cx, cy, k1 = camera.params
            camera.model = pycolmap.CameraModelId.OPENCV
            camera.params = [focal, focal, cx, cy, k1, 0.0, 0.0, 0.0]
            changed = True
    return changed


def bundle_adjust(
    model: pycolmap.Reconstruction, threads: int, *, fixed_intrinsics: bool, cancelled: Callable[[], bool]
) -> None:
    """Adjust all poses, points and (unless fixed) lenses to convergence, with a robust loss, in place.

    Raises Cancelled at the end, when the caller has asked to stop.
    """
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = False
    options.refine_focal_length = options.refine_extra_params = not fixed_intrinsics
    options.ceres.use_gpu = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = threads
    options.ceres.solver_options.max_num_iterations = MAX_ITERATIONS
    options.ceres.solver_options.function_tolerance = FUNCTION_TOLERANCE
    options.ceres.min_num_residuals_for_cpu_multi_threading = 5000
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    # Fixes the seven degrees of gauge freedom, as `pycolmap.bundle_adjustment` does; that function also logs.
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()
    stop_if(cancelled)
