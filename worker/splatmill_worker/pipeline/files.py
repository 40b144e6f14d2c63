"""The last stage: the files of the model, from its Gaussians to its report."""

from __future__ import annotations

from typing import Any

import av

from splatmill_worker.pipeline.cameras import Cameras
from splatmill_worker.pipeline.job import Job
from splatmill_worker.pipeline.stage_times import Stages
from splatmill_worker.pipeline.training import Recording
from splatmill_worker.sfm.posed.written import write_cameras
from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.report.export import export
from splatmill_worker.splat.report.report import PlannedScene, write_report
from splatmill_worker.splat.train.loop import Trained
from splatmill_worker.splat.train.renderer import renderer


def write_files(
    job: Job,
    cameras: Cameras,
    planned: PlannedScene,
    engine: Engine,
    trained: Trained,
    record: Recording,
    stages: Stages,
) -> None:
    """Write the model, its cameras, the last preview, the film and the report."""
    plan, world = planned.plan, cameras.exported
    with stages.measured("export"):
        record.events.writing("the model and the photos that were held out")
        exported = export(job.out, trained, plan, world, planned.held_out)
        record.events.writing("the cameras and a preview")
        write_cameras(
            job.out / "cameras.zip",
            cameras.scene,
            {v.name: world.camera(v.full.camera).viewmat for v in (*trained.views, *planned.held_out)},
            world.offset,
            frozenset(view.name for view in planned.held_out),
        )
        record.events.preview(engine, trained.steps)
    if record.film is not None:
        try:
            record.film.develop(job.out / "progress.mp4")
        except (av.FFmpegError, OSError, ValueError) as error:
            # The model is complete: a film that cannot be encoded must not fail the job.
            record.events.warn(f"The film of the training could not be written: {error}.")
        stages.add("film", record.film.seconds)
    lapse: list[dict[str, Any]] = []
    if record.lapse is not None:
        lapse = record.lapse.publish(job.out)
        stages.add("time_lapse", record.lapse.seconds)
    if job.looks is not None and job.looks.seconds:
        stages.add("live", job.looks.seconds)
    record.events.writing("the report")
    write_report(
        job.out,
        planned,
        trained,
        exported,
        renderer(engine, plan),
        seconds=stages.seconds,
        warnings=[*cameras.scene.warnings, *record.events.warnings],
        time_lapse=lapse,
    )
