"""Camera poses and points from verified matches: one photo after another, or all at once (GLOMAP)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from splatmill_worker.colmap import pycolmap
from splatmill_worker.sfm.cancellation import stop_if
from splatmill_worker.sfm.merge import merged

Mapper = Literal["incremental", "global"]
LENS_PHOTOS = 8
LENS_OBSERVATIONS = 2000


@dataclass(frozen=True)
class Mapped:
    """All models a mapper made, the one with the most photos first; `joined` others are part of it already.

    `notes` are sentences for a person.
    """

    mapper: Mapper
    models: tuple[pycolmap.Reconstruction, ...]
    joined: int
    seconds: float
    notes: tuple[str, ...] = ()

    @property
    def largest(self) -> pycolmap.Reconstruction | None:
        return self.models[0] if self.models else None

    @property
    def registered(self) -> int:
        return self.models[0].num_reg_images() if self.models else 0


def run(
    mapper: Mapper,
    path: Path,
    count: int,
    threads: int,
    seed: int,
    *,
    relaxed: bool = False,
    fixed_intrinsics: bool = False,
    on_progress: Callable[[int, int], None],
    cancelled: Callable[[], bool],
) -> Mapped:
    """Maps the `count` photos in the database at `path`.

    `relaxed` accepts smaller parallax and fewer inliers; `fixed_intrinsics` leaves the cameras as they are.
    Raises Cancelled: between two photos for the incremental mapper; the global one only notices afterwards.
    """
    started = time.perf_counter()
    stop_if(cancelled)
    database = pycolmap.Database.open(path)
    try:
        manager = pycolmap.ReconstructionManager()
        if mapper == "incremental":
            options = _incremental(threads, seed, relaxed, fixed_intrinsics)
            incremental = pycolmap.IncrementalPipeline(options, database, manager)
            placed = 0

            def told() -> None:
                nonlocal placed
                placed = min(placed + 1, count)
                on_progress(placed, count)
                stop_if(cancelled)

            callback = pycolmap.IncrementalPipelineCallback
            incremental.add_callback(callback.INITIAL_IMAGE_PAIR_REG_CALLBACK, told)
            incremental.add_callback(callback.NEXT_IMAGE_REG_CALLBACK, told)
            incremental.run()
        else:
            pycolmap.GlobalPipeline(_global(threads, seed, fixed_intrinsics), database, manager).run()
    finally:
        database.close()
    stop_if(cancelled)
    models = [manager.get(index) for index in range(manager.size())]
    models.sort(key=lambda model: (-model.num_reg_images(), -model.num_points3D()))
    models, count_joined, notes = together(models)
    return Mapped(mapper, tuple(models), count_joined, time.perf_counter() - started, notes)


def together(
    models: list[pycolmap.Reconstruction],
) -> tuple[list[pycolmap.Reconstruction], int, tuple[str, ...]]:
    """The models after those that share photos with the first were joined to it, how many, and notes.

    Where COLMAP refuses to join them they stay as they are: the first may be good without the others.
    """
    if len(models) < 2:
        return models, 0, ()
    try:
        whole, joined = merged(models)
    except (RuntimeError, ValueError, LookupError) as error:
        said = (str(error).strip().splitlines() or ["no message"])[0][:200]
        note = (
            f"The photos form {len(models)} models that could not be joined; the largest is used. "
            f"Joining them ended with {type(error).__name__}: {said}"
        )
        return models, 0, (note,)
    apart = [model for index, model in enumerate(models) if index > 0 and index not in joined]
    return [whole, *apart], len(joined), ()


def _incremental(threads: int, seed: int, relaxed: bool, fixed: bool) -> pycolmap.IncrementalPipelineOptions:
    """COLMAP's settings, with bundle adjustment as rare and as short as the final poses allow.

    On fox (50 photos, 800 px) this takes half the time of the defaults and moves no camera by more than
    0.03 degrees; the last adjustment is run to convergence by `polish`.
    """
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = threads
    options.random_seed = seed
    options.extract_colors = False
    options.min_model_size = 3
    options.max_num_models = 8
    options.init_num_trials = 50
    options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.4
    options.ba_global_max_refinements = 2
    options.ba_local_max_refinements = 1
    options.ba_global_function_tolerance = 1e-4
    options.ba_local_function_tolerance = 1e-3
    options.ba_min_num_residuals_for_cpu_multi_threading = 5000
    if relaxed:
        options.mapper.init_min_num_inliers = 40
        options.mapper.init_min_tri_angle = 5.0
        options.mapper.abs_pose_min_num_inliers = 18
        options.mapper.abs_pose_min_inlier_ratio = 0.15
    if fixed:
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    return options


def _global(threads: int, seed: int, fixed: bool) -> pycolmap.GlobalPipelineOptions:
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = threads
    # Each step draws its own numbers: with one seed left at its default no two runs agree.
    options.random_seed = options.mapper.random_seed = seed
    options.mapper.global_positioning.random_seed = options.mapper.rotation_averaging.random_seed = seed
    options.mapper.global_positioning.use_gpu = False
    options.mapper.bundle_adjustment.ceres.use_gpu = False
    if fixed:
        options.mapper.bundle_adjustment.refine_focal_length = False
        options.mapper.bundle_adjustment.refine_extra_params = False
    return options


def refine_lenses(model: pycolmap.Reconstruction) -> bool:
    """Turns cameras that enough photos speak for into OPENCV ones (k1, k2, p1, p2), in place; whether any was.

    Mapping runs on one radial coefficient, which few photos can determine; the last adjustment then finds the
    lens as it is (on fox the focal length moves by 0.5 per cent, onto that of the reference).
    """
    photos: dict[int, int] = {}
    observations: dict[int, int] = {}
    for image_id in model.reg_image_ids():
        image = model.images[image_id]
        photos[image.camera_id] = photos.get(image.camera_id, 0) + 1
        observations[image.camera_id] = observations.get(image.camera_id, 0) + image.num_points3D
    changed = False
    for camera_id, camera in model.cameras.items():
        enough = photos.get(camera_id, 0) >= LENS_PHOTOS and observations[camera_id] >= LENS_OBSERVATIONS
        if enough and camera.model == pycolmap.CameraModelId.SIMPLE_RADIAL:
            focal, cx, cy, k1 = camera.params
            camera.model = pycolmap.CameraModelId.OPENCV
            camera.params = [focal, focal, cx, cy, k1, 0.0, 0.0, 0.0]
            changed = True
    return changed


def polish(
    model: pycolmap.Reconstruction, threads: int, *, fixed_intrinsics: bool, cancelled: Callable[[], bool]
) -> None:
    """Bundle adjustment of the whole model to convergence, with a robust loss, in place."""
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = False
    options.refine_focal_length = options.refine_extra_params = not fixed_intrinsics
    options.ceres.use_gpu = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = threads
    options.ceres.solver_options.max_num_iterations = 50
    options.ceres.solver_options.function_tolerance = 1e-6
    options.ceres.min_num_residuals_for_cpu_multi_threading = 5000
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    # The seven degrees of freedom of the world; `pycolmap.bundle_adjustment` would do the same, and log about it.
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()
    stop_if(cancelled)
