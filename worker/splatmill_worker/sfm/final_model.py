"""The final model of a run: plausible intrinsics, no outliers, adjusted to convergence, and checked."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from splatmill_worker.colmap import pycolmap
from splatmill_worker.errors import SfmFailed
from splatmill_worker.sfm import checks, features
from splatmill_worker.sfm.cameras import CameraGroup
from splatmill_worker.sfm.effort import registered_photos
from splatmill_worker.sfm.mapping import adjust, mapper, precise
from splatmill_worker.sfm.mapping.registered import registered
from splatmill_worker.sfm.run import EffortResult, SfmRun
from splatmill_worker.sfm.world.frame import places_of
from splatmill_worker.sfm.world.position_priors import position_priors

MORE_WITH_GPS = 2
"""Adjustments that follow the first one with GPS, at most."""

BETTER = 0.8
"""Share of the error of GPS before an adjustment, as the cameras show it, below which another one follows: part of the
error was that of the cameras, and GPS counted for too little."""


@dataclass(frozen=True)
class FinalModel:
    """A model that passed the checks.

    model: poses and points.
    facts: figures about the photos, the pairs and the model.
    left_out: why a photo is not registered, by its index.
    notes: sentences for the user.
    warnings: sentences for the user about what may be wrong.
    """

    model: pycolmap.Reconstruction
    facts: dict[str, Any]
    left_out: dict[int, str]
    notes: tuple[str, ...]
    warnings: tuple[str, ...]


def final_model(run: SfmRun, result: EffortResult) -> FinalModel:
    """Complete the largest model of `result`; raises SfmFailed when it is not usable, and Cancelled."""
    facts = checks.pair_facts(result.matched) | {"effort": result.effort.name}
    facts["pairs_alike"] = len(result.left_out)
    if result.mapped is None or result.mapped.largest is None:
        checks.require_usable(checks.model_facts(None, run.count) | facts)
        raise AssertionError("a result without a model is never usable")
    mapped, model, fixed = _with_plausible_intrinsics(run, result, result.mapped, result.mapped.largest)
    deregistered = checks.deregister_outliers(model)
    outliers = {
        features.photo_index(model.images[image_id].name): reason for image_id, reason in deregistered.items()
    }
    with run.clock("polish"):
        model, warnings = _polished(run, result, model, fixed)
    facts |= checks.model_facts(model, run.count)
    checks.require_usable(facts)
    facts["features_per_photo"] = float(np.median([len(each.scales) for each in result.features]))
    facts |= _mapper_facts(run, mapped, model)
    left_out = _reasons(run, result, mapped, model) | outliers
    return FinalModel(model, facts, left_out, (*run.notes, *mapped.notes), warnings)


def _with_plausible_intrinsics(
    run: SfmRun, result: EffortResult, mapped: mapper.Mapped, model: pycolmap.Reconstruction
) -> tuple[mapper.Mapped, pycolmap.Reconstruction, bool]:
    """The mapping, its largest model, and whether its intrinsics are fixed.

    When intrinsics became implausible, the photos are mapped again with all intrinsics fixed at their initial values.
    Raises SfmFailed when too few photos are registered that way.
    """
    implausible = checks.implausible_intrinsics(model)
    if implausible is None:
        return mapped, model, False
    run.notes.append(
        f"The estimated camera has {implausible}, which no lens has; the photos were mapped again with each camera "
        "fixed at its initial focal length and without distortion."
    )
    with run.clock("mapping"):
        again = mapper.run(
            "incremental",
            result.view_graph,
            run.count,
            run.threads,
            run.options.seed,
            fixed_intrinsics=True,
            on_progress=run.on_mapping,
            on_model=run.show,
            cancelled=run.cancelled,
        )
    least = checks.min_registered(run.count)
    if again.largest is None or again.registered < least:
        raise SfmFailed(
            "sfm_failed",
            f"The estimated camera has {implausible}, which no lens has; with the initial focal length only "
            f"{again.registered} of {run.count} photos could be placed, and at least {least} are needed.",
            checks.pair_facts(result.matched) | checks.model_facts(again.largest, run.count),
            "Give the original photos, not cropped and all at the same zoom, taken from more sides.",
        )
    return again, again.largest, True


def _polished(
    run: SfmRun, result: EffortResult, model: pycolmap.Reconstruction, fixed: bool
) -> tuple[pycolmap.Reconstruction, tuple[str, ...]]:
    """The registered photos after the last bundle adjustment, and warnings about their lenses.

    Small features place the cameras, and then the points of all features are adjusted.
    """
    model = registered(model)
    adjust.update_errors(model)
    scales = {
        image_id: result.features[features.photo_index(model.images[image_id].name)].scales
        for image_id in model.reg_image_ids()
    }
    small = precise.without_large_features(model, scales)
    if small is None:
        return _adjusted(run, model, fixed)
    small, warnings = _adjusted(run, small, fixed)
    precise.take_cameras(model, small)
    adjust.bundle_adjust(
        model,
        run.threads,
        fixed_cameras=True,
        cancelled=run.cancelled,
        on_iterations=_reporter(run, model, f"{model.num_points3D()} points"),
    )
    return model, warnings


def _adjusted(
    run: SfmRun, model: pycolmap.Reconstruction, fixed: bool
) -> tuple[pycolmap.Reconstruction, tuple[str, ...]]:
    """The model after a bundle adjustment in which GPS takes part, and warnings about its lenses.

    `model` is changed, and may be left in metres. Where an adjustment makes the photos agree much better with GPS,
    another one follows, with priors of the smaller error.
    """
    photos = {
        image_id: run.prepared.photos[features.photo_index(model.images[image_id].name)]
        for image_id in model.reg_image_ids()
    }
    rows = places_of([photo.exif for photo in photos.values()])
    places = dict(zip(photos, rows, strict=True))
    gps = position_priors(model, places)
    if gps is None:
        return _solved(run, model, fixed, ())
    to_metres = gps.to_metres
    model.transform(to_metres)
    model, warnings = _solved(run, model, fixed, gps.priors)
    assumed = bool(warnings)  # the focal length of a camera, which is kept
    for _ in range(MORE_WITH_GPS):
        again = position_priors(model, places)
        if again is None or again.error >= BETTER * gps.error:
            break
        trial = copy.deepcopy(model)
        trial.transform(again.to_metres)
        adjust.bundle_adjust(
            trial,
            run.threads,
            fixed_intrinsics=fixed,
            fixed_focal=assumed,
            priors=again.priors,
            cancelled=run.cancelled,
            on_iterations=_reporter(run, trial),
        )
        if checks.implausible_intrinsics(trial) is not None:
            break
        model, gps, to_metres = trial, again, again.to_metres * to_metres
    model.transform(to_metres.inverse())
    run.notes.append(
        f"GPS took part in the last adjustment of the cameras: {len(gps.priors)} positions, with an assumed error of "
        f"{gps.error:.1f} m."
    )
    return model, warnings


def _solved(
    run: SfmRun, model: pycolmap.Reconstruction, fixed: bool, priors: Sequence[pycolmap.PosePrior]
) -> tuple[pycolmap.Reconstruction, tuple[str, ...]]:
    """The model after a bundle adjustment, and warnings about its lenses. `priors` are in the world of `model`."""
    report = _reporter(run, model)
    if fixed or run.options.camera_model != "auto":
        adjust.bundle_adjust(
            model,
            run.threads,
            fixed_intrinsics=fixed,
            priors=priors,
            cancelled=run.cancelled,
            on_iterations=report,
        )
        return model, ()
    adjust.use_opencv_fisheye(model)
    group_of = {index: group for group in run.groups for index in group.photos}
    groups = {
        model.images[image_id].camera_id: group_of[features.photo_index(model.images[image_id].name)]
        for image_id in model.reg_image_ids()
    }
    initial = {
        camera_id: group.focal * max(model.cameras[camera_id].width, model.cameras[camera_id].height)
        for camera_id, group in groups.items()
        if not group.is_panorama and not group.is_fisheye
    }
    if not initial:
        adjust.bundle_adjust(model, run.threads, priors=priors, cancelled=run.cancelled, on_iterations=report)
        return model, ()
    adjusted = adjust.adjust_with_lenses(model, initial, run.threads, run.cancelled, report, priors)
    if adjusted.tied:
        run.notes.append(
            "The photos do not determine whether the lens stretches them, since the camera moved along a line, around "
            "one axis or over a flat scene. Its pixels are assumed to be square, and its distortion radial."
        )
    return adjusted.model, tuple(_assumption(groups[camera]) for camera in sorted(adjusted.assumed))


def _reporter(run: SfmRun, model: pycolmap.Reconstruction, what: str = "") -> Callable[[int], None]:
    """Reports the iterations of an adjustment of `what`; where it is empty, of the cameras of `model`."""
    placed = model.num_reg_images()
    what = what or f"{placed} cameras and their lenses"

    def report(iterations: int) -> None:
        run.on_mapping(placed, run.count, f"adjusting {what}, iteration {iterations + 1}")

    return report


def _assumption(group: CameraGroup) -> str:
    photos = f"{len(group.photos)} photo{'s' if len(group.photos) > 1 else ''}"
    source = "is that of EXIF" if group.known else "is assumed, because EXIF has none"
    return (
        f"The focal length of {photos}, {group.focal:.2f} times the longest side, {source}: the motion of the camera "
        "does not determine it. If it is wrong, depths are wrong by the same factor. Photos from different distances "
        "and directions determine it."
    )


def _mapper_facts(run: SfmRun, mapped: mapper.Mapped, model: pycolmap.Reconstruction) -> dict[str, Any]:
    """Which mapper made the model, how many models were merged into it, and the photos of each of the others."""
    registered = registered_photos(model)
    others = [sorted(registered_photos(other) - registered) for other in mapped.models[1:]]
    return {
        "mapper": mapped.mapper,
        "merged_models": mapped.merged,
        "other_models": [[run.prepared.photos[index].name for index in own] for own in others if own],
    }


def _reasons(
    run: SfmRun, result: EffortResult, mapped: mapper.Mapped, model: pycolmap.Reconstruction
) -> dict[int, str]:
    """Why each unregistered photo has no camera: no match, too weak ones, or a separate model."""
    registered = registered_photos(model)
    partners: dict[int, int] = {}
    for pair in result.verified:
        for index in pair:
            partners[index] = partners.get(index, 0) + 1
    reasons = {}
    for index in range(run.count):
        if index in registered:
            continue
        if not partners.get(index):
            reasons[index] = "it matches no other photo"
        else:
            matches = f"{partners[index]} other photo{'s' if partners[index] > 1 else ''}"
            reasons[index] = f"it matches {matches}, but not well enough for its pose to be estimated"
    for number, other in enumerate(mapped.models[1:], 2):
        own = registered_photos(other) - registered
        for index in own & reasons.keys():
            reasons[index] = (
                f"it belongs to a separate model of {len(own)} photos, which share too little with the others "
                f"(model {number})"
            )
    return reasons
