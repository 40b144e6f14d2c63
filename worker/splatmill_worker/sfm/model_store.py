"""The stored model of a capture: COLMAP's files, the stereo points, the frame and facts.json in one folder."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from splatmill.schema import KnownDistance, ModelFrame
from splatmill_worker.colmap import pycolmap, write_model
from splatmill_worker.images.lens import remarks
from splatmill_worker.images.overlays import overlays
from splatmill_worker.images.panoramas import faces
from splatmill_worker.images.prepare import Prepared
from splatmill_worker.scene import Scene, View
from splatmill_worker.sfm import features, stereo
from splatmill_worker.sfm.callbacks import stop_if
from splatmill_worker.sfm.colors import color_points
from splatmill_worker.sfm.final_model import FinalModel
from splatmill_worker.sfm.posed.colmap_model import camera_and_lens, scene_of
from splatmill_worker.sfm.posed.model_files import ModelPoints
from splatmill_worker.sfm.run import SfmRun, torch_threads
from splatmill_worker.sfm.world.frame import choose, in_frame

STEREO = "stereo.npz"
FRAME = "frame.json"
"""How the world of COLMAP's files and the stereo points becomes that of the scene. A folder without it was stored
before there were frames; its scene keeps the world of its files, in which there may be checkpoints and models."""

FACTS = "facts.json"


def is_stored(folder: Path) -> bool:
    """Whether `folder` holds a complete model."""
    return (folder / FACTS).is_file()


def store_model(run: SfmRun, final: FinalModel, folder: Path) -> None:
    """Colour the points, add stereo points where there are few, and store all of it in `folder`, atomically.

    Raises Cancelled between two photos.
    """
    with run.clock("colors"):
        views = _views(run.prepared, final.model)

        def report(done: int) -> None:
            stop_if(run.cancelled)
            run.on_mapping(
                len(views), run.count, f"colours of the points, from {done} of {len(views)} photos"
            )

        color_points(final.model, views, run.pool, report)
    partial = folder.with_name(f"{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    write_model(final.model, partial)
    scene = scene_of(ModelPoints.of(final.model), views, source="sfm")
    if run.options.stereo and stereo.has_few_points(scene):
        # Photos are swept one after the other, so that each torch call gets all threads.
        with run.clock("stereo"), torch_threads(run.threads):
            stereo.with_stereo_points(faces.cut(scene), partial / STEREO, run.on_progress, run.cancelled)
    tags = {photo.name: photo.exif for photo in run.prepared.photos}
    frame = choose(scene, [tags[view.name] for view in scene.views])
    (partial / FRAME).write_text(frame.model_dump_json(indent=1), "utf-8")
    document = {
        "facts": final.facts
        | {"seconds": {stage: round(seconds, 3) for stage, seconds in run.seconds.items()}},
        "left_out": {run.prepared.photos[index].name: reason for index, reason in final.left_out.items()},
        "notes": list(final.notes),
        "warnings": list(final.warnings),
    }
    (partial / FACTS).write_text(json.dumps(document, indent=1), "utf-8")
    shutil.rmtree(folder, ignore_errors=True)
    partial.rename(folder)


def load_model(prepared: Prepared, folder: Path, known: KnownDistance | None = None) -> Scene:
    """The scene of the model that `store_model` wrote to `folder`, with the photos where they are now, in its frame.

    known: a distance that makes the metre its unit.

    Raises Refusal when that distance is between photos without a camera, or at one place.
    """
    model = pycolmap.Reconstruction(folder)
    document: dict[str, Any] = json.loads((folder / FACTS).read_text("utf-8"))
    scene = scene_of(
        ModelPoints.of(model),
        _views(prepared, model),
        source="sfm",
        left_out=(*prepared.skipped, *document["left_out"].items()),
        notes=(*prepared.notes, *document["notes"]),
    )
    scene = replace(
        scene,
        facts=document["facts"],
        warnings=(
            *prepared.warnings,
            *document["warnings"],
            *remarks(
                (view.lens for view in scene.views),
                {view.lens for view in scene.views if faces.is_divided(view)},
            ),
        ),
        overlays=prepared.overlays,
    )
    scene = faces.cut(scene)
    if (folder / STEREO).is_file():
        scene = stereo.add(scene, stereo.StereoPoints.load(folder / STEREO))
    return in_frame(scene, ModelFrame.model_validate_json((folder / FRAME).read_bytes()), known)


def _views(prepared: Prepared, model: pycolmap.Reconstruction) -> dict[int, View]:
    """The view of each registered image by its id, in order of the photos' names."""
    by_photo = {features.photo_index(model.images[i].name): i for i in model.reg_image_ids()}
    views = {}
    for index in sorted(by_photo):
        photo, image = prepared.photos[index], model.images[by_photo[index]]
        viewmat = np.eye(4)
        viewmat[:3] = image.cam_from_world().matrix()
        camera, lens = camera_and_lens(model.cameras[image.camera_id], viewmat)
        camera = camera.scaled_to(photo.width, photo.height)
        view = View(photo.name, camera, photo.path, photo.mask, lens, shown_from=photo.shown_from)
        views[by_photo[index]] = overlays.within_circle(view, photo.circle)
    return views
