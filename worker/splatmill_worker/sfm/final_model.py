"""The final model of a run: plausible intrinsics, no outliers, adjusted to convergence, and checked."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np

from splatmill_worker.colmap import pycolmap
from splatmill_worker.errors import SfmFailed
from splatmill_worker.sfm import checks, features
from splatmill_worker.sfm.effort import registered_photos
from splatmill_worker.sfm.mapping import adjust, mapper
from splatmill_worker.sfm.run import EffortResult, SfmRun


@dataclass(frozen=True)
class FinalModel:
    """A model that passed the checks.

    model: poses and points.
    facts: figures about the photos, the pairs and the model.
    left_out: why a photo is not registered, by its index.
    notes: sentences for the user.
    """

    model: pycolmap.Reconstruction
    facts: dict[str, Any]
    left_out: dict[int, str]
    notes: tuple[str, ...]


def final_model(run: SfmRun, result: EffortResult) -> FinalModel:
    """Complete the largest model of `result`; raises SfmFailed when it is not usable, and Cancelled."""
    facts = checks.pair_facts(result.matched) | {"effort": result.effort.name}
    facts["pairs_alike"] = len(result.left_out)
    if result.mapped is None or result.mapped.largest is None:
        checks.require_usable(checks.model_facts(None, run.count) | facts)
        raise AssertionError("a result without a model is never usable")
    mapped, model, fixed = _with_plausible_intrinsics(run, result, result.mapped, result.mapped.largest)
    deregistered = checks.deregister_outliers(model)
    with run.clock("polish"):
        model = _adjusted(run, model, fixed)
    facts |= checks.model_facts(model, run.count)
    checks.require_usable(facts)
    outliers = {
        features.photo_index(model.images[image_id].name): reason for image_id, reason in deregistered.items()
    }
    facts["features_per_photo"] = float(np.median([len(found.scales) for found in result.features]))
    facts |= _mapper_facts(run, mapped, model)
    left_out = _reasons(run, result, mapped, model) | outliers
    return FinalModel(model, facts, left_out, (*run.notes, *mapped.notes))


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
            on_progress=lambda done, total: run.on_progress("mapping", done, total, "photos registered"),
            on_model=run.show,
            cancelled=run.cancelled,
        )
    least = checks.min_registered(run.count)
    if again.largest is None or again.registered < least:
        raise SfmFailed(
            "sfm_failed",
            f"The estimated camera has {implausible}, which no lens has; with the initial focal length only "
            f"{again.registered} of {run.count} photos were registered, and at least {least} are needed.",
            checks.pair_facts(result.matched) | checks.model_facts(again.largest, run.count),
            "Give the original photos, not cropped and all at the same zoom, taken from more sides.",
        )
    return again, again.largest, True


def _adjusted(run: SfmRun, model: pycolmap.Reconstruction, fixed: bool) -> pycolmap.Reconstruction:
    """The model after the last bundle adjustment, with OPENCV cameras where that gives plausible intrinsics."""
    if not fixed and run.options.camera_model == "auto":
        detailed = copy.deepcopy(model)
        if adjust.use_opencv_cameras(detailed):
            adjust.bundle_adjust(detailed, run.threads, fixed_intrinsics=False, cancelled=run.cancelled)
            if checks.implausible_intrinsics(detailed) is None:
                return detailed
    adjust.bundle_adjust(model, run.threads, fixed_intrinsics=fixed, cancelled=run.cancelled)
    return model


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
