"""All stages of a job, one after the other: cameras, photos, plan, training, files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from splatmill.schema import JobState, PlanEvent, StateEvent, TrainOptions
from splatmill_worker.errors import Cancelled, Refusal
from splatmill_worker.pipeline.cameras import recover_cameras
from splatmill_worker.pipeline.events import Emit
from splatmill_worker.pipeline.files import write_files
from splatmill_worker.pipeline.first_gaussians import seeded
from splatmill_worker.pipeline.job import Job, check_lpips, choose_kernels
from splatmill_worker.pipeline.live import Looks, Onlookers
from splatmill_worker.pipeline.planning import Revise, plan_training, planned_photos
from splatmill_worker.pipeline.stage_times import Stages
from splatmill_worker.pipeline.training import train_scene
from splatmill_worker.splat.engine.open import open_engine
from splatmill_worker.splat.plan.photos import statistics_memory
from splatmill_worker.splat.report.report import PlannedScene
from splatmill_worker.splat.train.loop import Trained


@dataclass(frozen=True)
class Outcome:
    """How a run ended.

    ended: "succeeded" or "cancelled". A cancelled run can be resumed by another run in the same work folder.
    out: the folder with the model and the reports; they are complete only when the run succeeded.
    trained: the result of training; None for a cancelled run.
    """

    ended: str
    out: Path
    trained: Trained | None = None


def run(
    capture: Path,
    workdir: Path,
    options: TrainOptions,
    emit: Emit,
    cancelled: Callable[[], bool],
    *,
    onlookers: Onlookers | None = None,
    revise: Revise = lambda plan: plan,
) -> Outcome:
    """Train a scene from `capture`, and leave the model, its cameras and frame, and the reports in `workdir/out`.

    capture: folder with images/, and masks/ and poses/ where they were given.
    workdir: folder that is kept between attempts; what an earlier attempt stored there is used again.
    emit: called with each event as it happens. The states emitted are sfm, training and exporting; the caller emits
        the final one.
    cancelled: polled; when it returns true, the run ends with "cancelled". Training stores a checkpoint first.
    onlookers: those who look at the job while it runs; None: nobody does.
    revise: returns the plan to use in place of the one that was made; an ablation changes one decision with it.

    Raises Refusal, SfmFailed and TrainingFailed (see `errors`).
    """
    if options.tiles is not None:
        raise Refusal(
            "option_out_of_range",
            f"The option tiles is {options.tiles}, and this run trains a scene in one piece.",
            advice="splatmill_worker.tiles.job.run trains it in tiles, with the same arguments.",
        )
    stages = Stages(workdir / "stages.json")
    try:
        looks = None if onlookers is None else Looks(onlookers)
        job = Job(capture, workdir, options, choose_kernels(options), emit, cancelled, looks)
        check_lpips(options)
        job.out.mkdir(parents=True, exist_ok=True)
        job.warn_of_idle_gpu()
        emit(StateEvent(state=JobState.sfm))
        cameras = recover_cameras(job, stages)
        emit(StateEvent(state=JobState.training))
        planned = plan_training(job, cameras, revise, stages)
        emit(PlanEvent(plan=planned.plan.as_dict()))
        photos = planned_photos(job, cameras, planned, stages)
        plan = planned.plan
        first = seeded(job, planned.first, cameras, photos, plan, planned.seeds)
        engine = open_engine(
            first,
            plan.kernels,
            clustered=plan.cluster_culling,
            most_kept=statistics_memory(plan.max_memory, photos.size),
        )
        trained, record = train_scene(job, cameras, photos, plan, engine)
    except Cancelled:
        return Outcome("cancelled", workdir / "out")
    emit(StateEvent(state=JobState.exporting))
    scene = PlannedScene(cameras.scene, planned.facts.as_dict(), plan, photos.held_out)
    write_files(job, cameras, scene, engine, trained, record, stages)
    return Outcome("succeeded", job.out, trained)
