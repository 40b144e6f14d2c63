"""The first stage: the cameras of the photos, given or recovered, and which photos are held out."""

from __future__ import annotations

from dataclasses import dataclass, replace

from splatmill.schema import LogEvent
from splatmill_worker.images.panoramas import faces
from splatmill_worker.pipeline.capture import posed_scene
from splatmill_worker.pipeline.depth.given_depth import with_depth
from splatmill_worker.pipeline.events import progress_events
from splatmill_worker.pipeline.holdout.split import honest_split
from splatmill_worker.pipeline.job import Job
from splatmill_worker.pipeline.live import LiveCameras, placement_of, store_placement
from splatmill_worker.pipeline.stage_times import Stages
from splatmill_worker.scene import Normalization, Scene, View, omissions
from splatmill_worker.splat.report.export import ExportWorld


@dataclass(frozen=True)
class Cameras:
    """The posed scene in its own world and in the training world, and its split.

    scene: cameras and points in the world of the given poses or of the reconstruction.
    normalization: the similarity from that world to the training world.
    world: the scene in the training world.
    training, held_out: the views to train on and to evaluate on, in the world of `scene`.
    exported: the world of the exported files.
    """

    scene: Scene
    normalization: Normalization
    world: Scene
    training: tuple[View, ...]
    held_out: tuple[View, ...]
    exported: ExportWorld


def recover_cameras(job: Job, stages: Stages) -> Cameras:
    """The cameras that came with the photos or are recovered from them, and which photos are held out."""
    live = None if job.looks is None else LiveCameras(job.looks, job.emit, job.workdir)
    with stages.measured("sfm"):
        scene = posed_scene(
            job.capture,
            job.workdir,
            job.options,
            progress_events(job.emit),
            job.cancelled,
            live,
            job.prepared,
        )
    if job.looks is not None and job.looks.seconds:
        stages.add("sfm", -job.looks.seconds)
    parts = honest_split(faces.joined(scene), job.options)
    training, held_out = (
        tuple(face for view in views for face in faces.faces_of(view))
        for views in (parts.training, parts.held_out)
    )
    scene = replace(
        scene,
        left_out=(*scene.left_out, *parts.left_out),
        warnings=(*scene.warnings, *parts.warnings),
    )
    with stages.measured("sfm"):
        scene = with_depth(
            scene,
            {view.name for view in training},
            job.capture,
            job.workdir,
            job.options,
            progress_events(job.emit),
            job.cancelled,
        )
    views = {view.name: view for view in scene.views}
    training, held_out = (tuple(views[view.name] for view in part) for part in (training, held_out))
    for note in scene.notes:
        job.emit(LogEvent(message=note))
    for warning in scene.warnings:
        job.warn(warning)
    for sentence in omissions(scene.left_out):
        job.emit(LogEvent(level="warning", message=sentence, about="unused_photos"))
    normalization = Normalization.of(scene)
    world = ExportWorld.of(normalization, scene)
    placement = placement_of(scene, world, (view.name for view in held_out))
    store_placement(placement, job.workdir, job.emit)
    return Cameras(scene, normalization, normalization.apply(scene), training, held_out, world)
