"""From the best model of a run to a scene: what it is checked for, how it is stored and read back."""

from __future__ import annotations

import copy
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from splatmill_worker.colmap import pycolmap
from splatmill_worker.errors import SfmFailed
from splatmill_worker.images.prepare import Prepared
from splatmill_worker.scene import Scene, View
from splatmill_worker.sfm import checks, colors, features, mapping, stereo
from splatmill_worker.sfm.effort import edges, photos_of
from splatmill_worker.sfm.posed.colmap_model import posed_view, scene_of
from splatmill_worker.sfm.run import Progress, Run, torch_threads

STEREO = "stereo.npz"


def store(run: Run, progress: Progress, target: Path) -> None:
    """Checks the largest model, finishes it, and writes it with its facts; raises SfmFailed where it is not usable."""
    model = progress.mapped.largest if progress.mapped is not None else None
    facts = checks.pair_facts(progress.verified) | {"effort": progress.effort.name}
    if model is None:
        checks.require_usable(checks.model_facts(None, run.count) | facts)
        raise AssertionError("a run without a model is never usable")
    model, fixed = _with_possible_intrinsics(run, progress, model)
    misplaced = checks.drop_misplaced(model)
    with run.clock("polish"):
        model = _polished(run, model, fixed)
    facts |= checks.model_facts(model, run.count)
    checks.require_usable(facts)
    reasons = {
        features.photo_index(model.images[image_id].name): reason for image_id, reason in misplaced.items()
    }
    reasons = _reasons(run, progress, model) | reasons
    with run.clock("colors"):
        views = _views(run.prepared, model)
        colors.paint(model, views, run.pool)
    facts["features_per_photo"] = float(np.median([len(found.scales) for found in progress.features]))
    facts |= _model_facts(run, progress, model)
    partial = target.with_name(f"{target.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    model.write_binary(partial)
    scene = scene_of(model, views, source="sfm")
    if run.options.stereo and stereo.wanted(scene):
        # The photos are swept one after another: each has all threads.
        with run.clock("stereo"), torch_threads(run.threads):
            stereo.completed(scene, partial / STEREO, run.on_progress, run.cancelled)
    facts["seconds"] = {stage: round(seconds, 3) for stage, seconds in run.seconds.items()}
    notes = [*run.notes, *(progress.mapped.notes if progress.mapped is not None else ())]
    left_out = {run.prepared.photos[index].name: reason for index, reason in reasons.items()}
    document = {"facts": facts, "left_out": left_out, "notes": notes}
    (partial / "facts.json").write_text(json.dumps(document, indent=1), "utf-8")
    shutil.rmtree(target, ignore_errors=True)
    partial.rename(target)


def _model_facts(run: Run, progress: Progress, model: pycolmap.Reconstruction) -> dict[str, Any]:
    """Which mapper made the model, how many others were joined to it, and the photos of those that were not."""
    mapped = progress.mapped
    if mapped is None:
        return {"mapper": None}
    placed = photos_of(model)
    others = [sorted(photos_of(other) - placed) for other in mapped.models[1:]]
    return {
        "mapper": mapped.mapper,
        "merged_models": mapped.joined,
        "other_models": [[run.prepared.photos[index].name for index in own] for own in others if own],
    }


def _polished(run: Run, model: pycolmap.Reconstruction, fixed: bool) -> pycolmap.Reconstruction:
    """The model after its last bundle adjustment, with finer lenses where that leads to lenses that exist."""
    if not fixed and run.options.camera_model == "auto":
        finer = copy.deepcopy(model)
        if mapping.refine_lenses(finer):
            mapping.polish(finer, run.threads, fixed_intrinsics=False, cancelled=run.cancelled)
            if checks.absurd_intrinsics(finer) is None:
                return finer
    mapping.polish(model, run.threads, fixed_intrinsics=fixed, cancelled=run.cancelled)
    return model


def _with_possible_intrinsics(
    run: Run, progress: Progress, model: pycolmap.Reconstruction
) -> tuple[pycolmap.Reconstruction, bool]:
    """The model, mapped again with its cameras held where they started if they became what no lens can be."""
    absurd = checks.absurd_intrinsics(model)
    if absurd is None:
        return model, False
    run.notes.append(
        f"The photos led to {absurd}, which no lens has; the cameras were held at their first guess."
    )
    with run.clock("mapping"):
        again = mapping.run(
            "incremental",
            progress.place.database,
            run.count,
            run.threads,
            run.options.seed,
            fixed_intrinsics=True,
            on_progress=lambda done, total: run.on_progress("mapping", done, total, "photos placed"),
            cancelled=run.cancelled,
        )
    if again.largest is None or again.registered < checks.floor(run.count):
        facts = checks.pair_facts(progress.verified) | checks.model_facts(again.largest, run.count)
        raise SfmFailed(
            "sfm_failed",
            f"The photos led to {absurd}, which no lens has, and with the usual lens only {again.registered} of "
            f"{run.count} images could be placed.",
            facts,
            "Give the original photos, neither cropped nor taken at different zooms, from more sides.",
        )
    progress.mapped = again
    return again.largest, True


def _reasons(run: Run, progress: Progress, model: pycolmap.Reconstruction) -> dict[int, str]:
    """Why each photo without a camera has none; photos that form a smaller model of their own are told apart."""
    placed = photos_of(model)
    partners: dict[int, int] = {}
    for pair in edges(progress):
        for index in pair:
            partners[index] = partners.get(index, 0) + 1
    reasons = {}
    for index in range(run.count):
        if index in placed:
            continue
        if not partners.get(index):
            reasons[index] = "no other photo shows enough of what it shows"
        else:
            reasons[index] = f"it matches {partners[index]} other photos, but not well enough to be placed"
    for number, other in enumerate(progress.mapped.models[1:] if progress.mapped is not None else (), 2):
        own = photos_of(other) - placed
        for index in own & reasons.keys():
            reasons[index] = (
                f"it belongs to a part of {len(own)} photos that shares too little with the others (model {number})"
            )
    return reasons


def _views(prepared: Prepared, model: pycolmap.Reconstruction) -> dict[int, View]:
    """The view of each registered image by image id, in the order of the photos' names."""
    by_photo = {features.photo_index(model.images[i].name): i for i in model.reg_image_ids()}
    views = {}
    for index in sorted(by_photo):
        photo = prepared.photos[index]
        view = posed_view(model, by_photo[index], photo.name, photo.path, photo.mask)
        camera = view.camera.scaled_to(photo.width, photo.height)
        views[by_photo[index]] = replace(view, camera=camera, upright=True)
    return views


def read(prepared: Prepared, stored: Path) -> Scene:
    """The scene of a stored model; its photos are where they are now."""
    model = pycolmap.Reconstruction(stored)
    document: dict[str, Any] = json.loads((stored / "facts.json").read_text("utf-8"))
    scene = scene_of(
        model,
        _views(prepared, model),
        source="sfm",
        left_out=(*prepared.skipped, *document["left_out"].items()),
        notes=(*prepared.notes, *document["notes"]),
    )
    scene = replace(scene, facts=document["facts"])
    return stereo.add(scene, stereo.Added.load(stored / STEREO)) if (stored / STEREO).is_file() else scene
