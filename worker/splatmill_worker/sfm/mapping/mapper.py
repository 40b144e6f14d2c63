"""COLMAP's two mappers: incremental, which registers one photo after another, and global (GLOMAP)."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

from splatmill_worker.colmap import pycolmap
from splatmill_worker.sfm import checks
from splatmill_worker.sfm.callbacks import stop_if, watched
from splatmill_worker.sfm.mapping.incremental import IncrementalMapping
from splatmill_worker.sfm.mapping.merge import merge

Mapper = Literal["incremental", "global"]

GLOBAL_REPORT_SECONDS = 2.0
"""Seconds between two reports of the global mapper, which does not say how far it is."""


@dataclass(frozen=True)
class Mapped:
    """Models that a mapper reconstructed from one view graph.

    mapper: the mapper that made them.
    models: in order of the number of registered photos, the most first.
    merged: number of models that were merged into the first one and are no longer listed.
    notes: sentences for the user.
    """

    mapper: Mapper
    models: tuple[pycolmap.Reconstruction, ...]
    merged: int
    notes: tuple[str, ...] = ()

    @property
    def largest(self) -> pycolmap.Reconstruction | None:
        """The model with the most registered photos; None when no model was found."""
        return self.models[0] if self.models else None

    @property
    def registered(self) -> int:
        """Number of photos registered in the largest model."""
        return self.models[0].num_reg_images() if self.models else 0

    @cached_property
    def reliable(self) -> frozenset[int]:
        """Ids of the images that the largest model had registered reliably when this was first asked for."""
        return frozenset(checks.reliably_registered(self.largest))


def run(
    mapper: Mapper,
    database_path: Path,
    count: int,
    threads: int,
    seed: int,
    *,
    relaxed: bool = False,
    fixed_intrinsics: bool = False,
    cluster_models: Sequence[pycolmap.Reconstruction] = (),
    on_progress: Callable[[int, int, str], None],
    on_model: Callable[[pycolmap.Reconstruction], None] = lambda _: None,
    cancelled: Callable[[], bool],
) -> Mapped:
    """Map the `count` photos in COLMAP's database.

    relaxed: accept smaller triangulation angles and fewer inliers (incremental mapper only).
    fixed_intrinsics: keep focal lengths and distortion as they are in the database.
    cluster_models: models of clusters of the photos (`models_of`), which the incremental mapper joins and completes.
        Without them it begins with a first pair.
    on_progress: called as (photos placed, count, note) after each step of the incremental mapper; by the global one,
        which places all photos at once, every few seconds.
    on_model: called with the model that grows, after each step of the incremental mapper, which waits meanwhile.

    Raises Cancelled: between two steps of the incremental mapper, at the end in the global one.
    """
    stop_if(cancelled)
    before, joined_notes = 0, tuple[str, ...]()
    database = pycolmap.Database.open(database_path)
    try:
        if mapper == "incremental":
            options = _incremental_options(threads, seed, relaxed, fixed_intrinsics)
            mapping = IncrementalMapping(database, options, _Steps(count, on_progress, on_model), cancelled)
            if cluster_models:
                placed = len({image for model in cluster_models for image in model.reg_image_ids()})
                on_progress(placed, count, f"{len(cluster_models)} parts of the model are joined")
                models, before, joined_notes = merge_models(sorted(cluster_models, key=_size))
                stop_if(cancelled)
                mapping.joined(models[0])
            else:
                models = sorted(mapping.models(), key=_size)
            # Weak evidence is enough only beside a model of most photos: a small one may be of alike things.
            if models and 2 * models[0].num_reg_images() >= count:
                mapping.extended(models[0])
        else:
            models = _global_models(
                database, _global_options(threads, seed, fixed_intrinsics), count, on_progress, cancelled
            )
    finally:
        database.close()
    stop_if(cancelled)
    models.sort(key=_size)
    models, merged, notes = merge_models(models)
    return Mapped(mapper, tuple(models), before + merged, joined_notes + notes)


def models_of(
    database_path: Path,
    images: Collection[int],
    threads: int,
    seed: int,
    *,
    on_progress: Callable[[int, int, str], None],
    on_model: Callable[[pycolmap.Reconstruction], None],
    cancelled: Callable[[], bool],
) -> list[pycolmap.Reconstruction]:
    """Models of some of the photos in COLMAP's database, by the incremental mapper, the largest first.

    images: COLMAP's ids of the photos. The other arguments are those of `run`. Raises Cancelled between two steps.
    """
    options = _incremental_options(threads, seed, relaxed=False, fixed_intrinsics=False)
    database = pycolmap.Database.open(database_path)
    try:
        options.image_names = [database.read_image(image).name for image in images]
        steps = _Steps(len(images), on_progress, on_model)
        return sorted(IncrementalMapping(database, options, steps, cancelled).models(), key=_size)
    finally:
        database.close()


def extend(
    mapped: Mapped,
    database_path: Path,
    count: int,
    threads: int,
    seed: int,
    *,
    on_progress: Callable[[int, int, str], None],
    on_model: Callable[[pycolmap.Reconstruction], None],
    cancelled: Callable[[], bool],
) -> Mapped:
    """Add photos to the largest of the models, by pairs that COLMAP's database has gained since they were made.

    The arguments are those of `run`, whose models are left as they are. Raises Cancelled between two steps.
    """
    if mapped.largest is None:
        return mapped
    model = copy.deepcopy(mapped.largest)
    database = pycolmap.Database.open(database_path)
    try:
        options = _incremental_options(threads, seed, relaxed=False, fixed_intrinsics=False)
        steps = _Steps(count, on_progress, on_model)
        IncrementalMapping(database, options, steps, cancelled).extended(model)
    finally:
        database.close()
    return replace(mapped, models=(model, *mapped.models[1:]))


class _Steps:
    """Reports the steps of an incremental mapping."""

    def __init__(
        self,
        count: int,
        on_progress: Callable[[int, int, str], None],
        on_model: Callable[[pycolmap.Reconstruction], None],
    ) -> None:
        self._count, self._on_progress, self._on_model = count, on_progress, on_model
        self._placed = 0

    def __call__(self, model: pycolmap.Reconstruction, next_step: str) -> None:
        # Many first pairs are tried, and further models begin with one: the largest model of more than a pair is shown.
        if largest := model.num_reg_images() >= self._placed:
            self._placed = model.num_reg_images()
        self._on_progress(self._placed, self._count, next_step or "photos placed")
        if largest and self._placed > 2:
            self._on_model(model)


def _global_models(
    database: pycolmap.Database,
    options: pycolmap.GlobalPipelineOptions,
    count: int,
    on_progress: Callable[[int, int, str], None],
    cancelled: Callable[[], bool],
) -> list[pycolmap.Reconstruction]:
    manager = pycolmap.ReconstructionManager()
    started = reported = time.monotonic()

    def observe() -> None:
        nonlocal reported
        if (now := time.monotonic()) >= reported + GLOBAL_REPORT_SECONDS:
            reported = now
            on_progress(0, count, f"placing all photos at once, for {now - started:.0f} s")

    watched(lambda _: pycolmap.GlobalPipeline(options, database, manager).run(), cancelled, observe)
    return [manager.get(index) for index in range(manager.size())]


def _size(model: pycolmap.Reconstruction) -> tuple[int, int]:
    """Sorts the largest first."""
    return -model.num_reg_images(), -model.num_points3D()


def merge_models(
    models: list[pycolmap.Reconstruction],
) -> tuple[list[pycolmap.Reconstruction], int, tuple[str, ...]]:
    """Merge into the first model all that share enough photos with it.

    Returns the models that are left, the number of those merged into the first, and notes for the user. When COLMAP
    fails to merge them, they are returned as they were: the first one may be good without the others.
    """
    if len(models) < 2:
        return models, 0, ()
    try:
        first, merged = merge(models)
    except (RuntimeError, ValueError, LookupError) as error:
        reason = (str(error).strip().splitlines() or ["no message"])[0][:200]
        note = (
            f"The photos form {len(models)} separate models, and merging them failed "
            f"({type(error).__name__}: {reason}). Only the largest model is used."
        )
        return models, 0, (note,)
    apart = [model for index, model in enumerate(models) if index > 0 and index not in merged]
    return [first, *apart], len(merged), ()


def _incremental_options(
    threads: int, seed: int, relaxed: bool, fixed_intrinsics: bool
) -> pycolmap.IncrementalPipelineOptions:
    """COLMAP's defaults with fewer and shorter bundle adjustments (decisions: BUNDLE_ADJUSTMENT).

    `adjust.bundle_adjust` runs the last one to convergence.
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
    if fixed_intrinsics:
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    return options


def _global_options(threads: int, seed: int, fixed_intrinsics: bool) -> pycolmap.GlobalPipelineOptions:
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = threads
    # Each step has its own random generator; results are reproducible only when all of them are seeded.
    options.random_seed = options.mapper.random_seed = seed
    options.mapper.global_positioning.random_seed = options.mapper.rotation_averaging.random_seed = seed
    options.mapper.global_positioning.use_gpu = False
    options.mapper.bundle_adjustment.ceres.use_gpu = False
    if fixed_intrinsics:
        options.mapper.bundle_adjustment.refine_focal_length = False
        options.mapper.bundle_adjustment.refine_extra_params = False
    return options
