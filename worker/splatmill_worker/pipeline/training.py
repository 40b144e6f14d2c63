"""The fourth stage: training from the first Gaussians or from a checkpoint, and what is recorded on the way."""

from __future__ import annotations

from dataclasses import dataclass

from splatmill.schema import TIME_LAPSE, ProgressVideo
from splatmill_worker.pipeline.cameras import Cameras
from splatmill_worker.pipeline.events import TrainingEvents
from splatmill_worker.pipeline.job import Job
from splatmill_worker.pipeline.live import LiveScene
from splatmill_worker.pipeline.photos import Photos
from splatmill_worker.pipeline.progress_film import ProgressFilm, orbit_of
from splatmill_worker.pipeline.time_lapse import TimeLapse
from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.train import checkpoint
from splatmill_worker.splat.train.loop import Hooks, Trained, train
from splatmill_worker.splat.train.snapshot import Snapshot

EXTENT = 1.1
"""Scene extent, which scales the learning rate of the positions, in units of the training world: the farthest camera is
at distance 1, and the implementation of Kerbl et al. 2023 adds a tenth."""


@dataclass(frozen=True)
class Recording:
    """What is recorded while a scene is trained.

    events: emits them, and holds the warnings.
    film: the frames of the progress film; None where the options ask for no film.
    lapse: the snapshots of the training; None where none are kept.
    """

    events: TrainingEvents
    film: ProgressFilm | None
    lapse: TimeLapse | None


def train_scene(
    job: Job, cameras: Cameras, photos: Photos, plan: Plan, engine: Engine
) -> tuple[Trained, Recording]:
    """Train to the end of the budget, from the checkpoint of an earlier attempt where there is one."""
    earlier = _resumable(job, photos)
    record = _recording(job, cameras, photos, plan, anew=earlier is None)
    live = None if job.looks is None else LiveScene(job.looks, cameras.exported, plan.antialias)
    trained = train(
        engine,
        photos.training,
        photos.held_out,
        plan,
        extent=EXTENT,
        hooks=Hooks(
            progress=record.events.progress,
            evaluated=record.events.evaluated,
            evaluating=record.events.evaluating,
            warn=record.events.warn,
            cancelled=job.cancelled,
            checkpoint=lambda snapshot: checkpoint.save(job.checkpoints, snapshot),
            observers=[each for each in (record.film, record.lapse, live) if each is not None],
        ),
        resume_from=earlier,
    )
    return trained, record


def _recording(job: Job, cameras: Cameras, photos: Photos, plan: Plan, *, anew: bool) -> Recording:
    """anew: drop what earlier attempts recorded."""
    film = lapse = None
    if job.options.progress_video is not ProgressVideo.off:
        path = None
        if job.options.progress_video is ProgressVideo.orbit:
            path = orbit_of([*photos.training, *photos.held_out], cameras.exported)
        film = ProgressFilm(job.workdir / "film", photos.shown, plan, path, anew=anew)
    if job.keeps_time_lapse:
        folder = job.workdir / TIME_LAPSE
        lapse = TimeLapse(folder, cameras.exported, anew=anew, antialiased=plan.antialias)
    return Recording(TrainingEvents(job.emit, job.workdir, plan, photos.shown), film, lapse)


def _resumable(job: Job, photos: Photos) -> Snapshot | None:
    """The checkpoint of an earlier attempt that trained on the same photos; None without one."""
    snapshot = checkpoint.load(job.checkpoints)
    names = tuple(view.name for view in photos.training)
    return snapshot if snapshot is not None and snapshot.view_names == names else None
