"""COLMAP's incremental mapper, called step by step: one photo after another, with bundle adjustments in between.

The steps and their order are those of COLMAP's `IncrementalPipeline` (Schönberger and Frahm, "Structure-from-Motion
Revisited", CVPR 2016), whose single call reports nothing while it adjusts all cameras, and cannot end
meanwhile. Here progress is reported between any two steps, and photos that are left are added to the model that exists,
with weaker evidence.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

from splatmill_worker.colmap import pycolmap
from splatmill_worker.sfm.callbacks import stop_if
from splatmill_worker.sfm.mapping.adjust import iterations_at_once

OnStep = Callable[[pycolmap.Reconstruction, str], None]
"""Called after each step with the model that grows, and with words for the bundle adjustment that follows, if any."""

RELAXATIONS = ((1, 1), (2, 1), (2, 2), (4, 2), (4, 4))
"""Divisors of the inliers and of the angle that the first pair of a model needs: COLMAP's, one after the other."""

INITIAL_TRIALS = 30
"""Photos that are tried as the next of a young model before another first pair is; COLMAP's."""

WEAK_INLIERS, WEAK_INLIER_RATIO = 18, 0.15
"""Points that the pose of a photo which is left needs at least, and their share of its matches; COLMAP's defaults are
30 and 0.25. `checks.deregister_outliers` judges the poses at the end."""

SEAM_ITERATIONS = 5
"""Iterations of the adjustment after models were joined, before tracks are connected across their seams (decisions:
clusters)."""

_Status = pycolmap.IncrementalPipelineStatus


class IncrementalMapping:
    """Models from the view graph in COLMAP's database.

    options: of COLMAP's pipeline.
    on_step: called after each step.
    cancelled: polled after each step.
    """

    def __init__(
        self,
        database: pycolmap.Database,
        options: pycolmap.IncrementalPipelineOptions,
        on_step: OnStep,
        cancelled: Callable[[], bool],
    ) -> None:
        self._options, self._on_step, self._cancelled = options, on_step, cancelled
        # The pipeline is used for its cache of the database, and for the search for a first pair.
        self._pipeline = pycolmap.IncrementalPipeline(options, database, pycolmap.ReconstructionManager())
        self._mapper = pycolmap.IncrementalMapper(self._pipeline.database_cache)
        self._triangulation = options.get_triangulation()

    def models(self) -> list[pycolmap.Reconstruction]:
        """Models of the photos, the first of which is grown from the best first pair.

        Further ones are grown from photos that are left, with ever weaker first pairs; each takes in photos of the
        first one, too, by which it may be merged.
        """
        photos = self._pipeline.database_cache.num_images()
        models: list[pycolmap.Reconstruction] = []
        for fewer, narrower in RELAXATIONS:
            if len(models) == self._options.max_num_models or self._mapper.num_total_reg_images() == photos:
                break
            options = self._options.get_mapper()
            options.init_min_num_inliers //= fewer
            options.init_min_tri_angle /= narrower
            self._mapper.reset_initialization_stats()
            models += self._grown(options, len(models))
        return models

    def extended(self, model: pycolmap.Reconstruction) -> int:
        """Add photos that are left to `model`, in place, with WEAK_INLIERS; returns the number of those added."""
        options = self._options.get_mapper()
        options.abs_pose_min_num_inliers = min(WEAK_INLIERS, options.abs_pose_min_num_inliers)
        options.abs_pose_min_inlier_ratio = min(WEAK_INLIER_RATIO, options.abs_pose_min_inlier_ratio)
        self._mapper = pycolmap.IncrementalMapper(self._pipeline.database_cache)
        self._mapper.begin_reconstruction(model)
        before = model.num_reg_images()
        self._grow(model, options)
        self._mapper.end_reconstruction(False)
        return int(model.num_reg_images()) - before

    def joined(self, model: pycolmap.Reconstruction) -> None:
        """Complete `model`, which several were merged into, in place: its tracks, and photos that are left."""
        options = self._options.get_mapper()
        self._mapper = pycolmap.IncrementalMapper(self._pipeline.database_cache)
        self._mapper.begin_reconstruction(model)
        self._complete(model, options)
        self._grow(model, options)
        self._mapper.end_reconstruction(False)

    def _grown(
        self, options: pycolmap.IncrementalMapperOptions, kept: int
    ) -> Iterator[pycolmap.Reconstruction]:
        """Models with first pairs by these options, beside the `kept` ones."""
        photos = self._pipeline.database_cache.num_images()
        least = min(int(0.8 * photos), self._options.min_model_size)
        for _ in range(self._options.init_num_trials):
            model = pycolmap.Reconstruction()
            self._mapper.begin_reconstruction(model)
            status = self._pipeline.initialize_reconstruction(self._mapper, options, model)
            self._step(model)
            if status == _Status.SUCCESS:
                self._grow(model, options)
            placed = self._mapper.num_total_reg_images()
            size = model.num_reg_images()
            discarded = status != _Status.SUCCESS or size == 0 or (kept > 0 and size < least)
            self._mapper.end_reconstruction(discarded)
            if not discarded:
                kept += 1
                yield model
            if (
                status == _Status.NO_INITIAL_PAIR
                or kept == self._options.max_num_models
                or placed >= photos - 1
            ):
                return

    def _grow(self, model: pycolmap.Reconstruction, options: pycolmap.IncrementalMapperOptions) -> None:
        """Place one photo after another, and adjust all cameras each time that the model has grown enough."""
        adjusted = model.num_reg_frames(), model.num_points3D()
        more = True
        while True:
            photo = self._next(model, options)
            if photo is None:
                if not more or adjusted == (model.num_reg_frames(), model.num_points3D()):
                    return
                # Photos that could not be placed may be once all cameras are adjusted.
                more = False
            else:
                more = True
                self._mapper.triangulate_image(self._triangulation, photo)
                self._mapper.iterative_local_refinement(
                    self._options.ba_local_max_refinements,
                    self._options.ba_local_max_refinement_change,
                    options,
                    self._options.get_local_bundle_adjustment(),
                    self._triangulation,
                    photo,
                )
                self._step(model)
                if not self._pipeline.check_run_global_refinement(model, *adjusted):
                    continue
            self._adjust(model, options)
            adjusted = model.num_reg_frames(), model.num_points3D()

    def _next(self, model: pycolmap.Reconstruction, options: pycolmap.IncrementalMapperOptions) -> int | None:
        """The photo that was placed next, by the points that it shows or else by its matches; None where none could."""
        for without_points, place in (
            (False, self._mapper.register_next_image),
            (True, self._mapper.register_next_structure_less_image),
        ):
            for trial, photo in enumerate(self._mapper.find_next_images(options, without_points)):
                if place(options, photo):
                    return int(photo)
                self._step(model)
                if trial >= INITIAL_TRIALS and model.num_reg_images() < self._options.min_model_size:
                    break
        return None

    def _complete(self, model: pycolmap.Reconstruction, options: pycolmap.IncrementalMapperOptions) -> None:
        """Connect tracks across the seams of a model that was joined, whose cameras are adjusted to the end later.

        What does not fit yet is kept until an adjustment with a robust loss has moved the parts to each other.
        """
        self._mapper.complete_and_merge_tracks(self._triangulation)
        self._mapper.retriangulate(self._triangulation)
        self._solve(model, options, f"adjusting {model.num_reg_images()} cameras", seam=True)
        self._mapper.complete_and_merge_tracks(self._triangulation)
        self._mapper.filter_points(options)
        self._mapper.filter_frames(options)
        self._step(model)

    def _adjust(self, model: pycolmap.Reconstruction, options: pycolmap.IncrementalMapperOptions) -> None:
        """Adjust all cameras and points, complete and filter tracks, and again while that changes much."""
        self._mapper.complete_and_merge_tracks(self._triangulation)
        self._mapper.retriangulate(self._triangulation)
        for number in range(self._options.ba_global_max_refinements):
            observations = model.compute_num_observations()
            self._solve(model, options, f"adjusting {model.num_reg_images()} cameras, pass {number + 1}")
            model.normalize()
            changed = self._mapper.complete_and_merge_tracks(self._triangulation)
            changed += self._mapper.filter_points(options)
            self._step(model)
            if changed < self._options.ba_global_max_refinement_change * observations:
                break
        self._mapper.filter_frames(options)

    def _solve(
        self,
        model: pycolmap.Reconstruction,
        options: pycolmap.IncrementalMapperOptions,
        words: str,
        *,
        seam: bool = False,
    ) -> None:
        """One bundle adjustment of all cameras and points, in several calls where one would take long.

        seam: of a model that was joined: a few iterations, with a robust loss.
        """
        adjustment = self._options.get_global_bundle_adjustment()
        if seam:
            adjustment.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
            adjustment.ceres.solver_options.max_num_iterations = SEAM_ITERATIONS
        most = adjustment.ceres.solver_options.max_num_iterations
        at_once = iterations_at_once(model, most)
        adjustment.ceres.solver_options.max_num_iterations = at_once
        error = math.inf
        for done in range(0, most, at_once):
            self._step(model, words if done == 0 else f"{words}, iteration {done + 1}")
            self._mapper.adjust_global_bundle(options, adjustment)
            if at_once < most:
                # COLMAP does not return whether it has converged. A point behind a camera has an error of 1e154 pixels.
                self._mapper.observation_manager.filter_observations_with_negative_depth()
                model.update_point_3d_errors()
                last, error = error, model.compute_mean_reprojection_error()
                if error >= (1.0 - self._options.ba_global_function_tolerance) * last:
                    return

    def _step(self, model: pycolmap.Reconstruction, next_step: str = "") -> None:
        self._on_step(model, next_step)
        stop_if(self._cancelled)
