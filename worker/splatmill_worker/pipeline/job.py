"""One job: each stage in turn, from the photos of a capture to the files of its model."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import av
import torch

from splatmill.schema import (
    TIME_LAPSE,
    Backend,
    JobState,
    LogEvent,
    PlanEvent,
    StateEvent,
    Switch,
    TrainOptions,
)
from splatmill_worker import memory
from splatmill_worker.errors import Cancelled, Refusal
from splatmill_worker.images.load import load_views
from splatmill_worker.kernels.gpu.device import absence, describe
from splatmill_worker.pipeline.capture import choose_kernels, honest_split, posed_scene, start_model_path
from splatmill_worker.pipeline.events import Emit, TrainingEvents, progress_events
from splatmill_worker.pipeline.live import (
    LiveCameras,
    LiveScene,
    Looks,
    Onlookers,
    placement_of,
    store_placement,
)
from splatmill_worker.pipeline.progress_film import ProgressFilm
from splatmill_worker.pipeline.stage_times import Stages
from splatmill_worker.pipeline.time_lapse import TimeLapse
from splatmill_worker.scene import Normalization, Scene, View, omissions
from splatmill_worker.sfm.posed.written import write_cameras
from splatmill_worker.splat.engine.open import open_engine
from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.plan.capacity import resolved
from splatmill_worker.splat.plan.decide import decide
from splatmill_worker.splat.plan.facts import Facts, measure
from splatmill_worker.splat.plan.light import Light
from splatmill_worker.splat.plan.photos import loading_size
from splatmill_worker.splat.plan.plan import Kernels, Plan
from splatmill_worker.splat.plan.plan_file import read_plan, write_plan
from splatmill_worker.splat.plan.probe import probe
from splatmill_worker.splat.report.export import ExportWorld, export
from splatmill_worker.splat.report.report import FinishedTraining, PlannedScene, write_report
from splatmill_worker.splat.start.frusta import RANDOM_GAUSSIANS, sample_frusta
from splatmill_worker.splat.start.given_model import LEAST_ASSESSED, GivenModel, assess, read_given_model
from splatmill_worker.splat.start.hull import Hull, NoHull, at_first, visual_hull
from splatmill_worker.splat.start.points import ENOUGH_POINTS, from_points
from splatmill_worker.splat.start.seeding import add_seeds
from splatmill_worker.splat.train import checkpoint
from splatmill_worker.splat.train.loop import Hooks, Trained, train
from splatmill_worker.splat.train.renderer import renderer
from splatmill_worker.splat.train.snapshot import Snapshot
from splatmill_worker.splat.views import TrainingView

EXTENT = 1.1
"""Scene extent, which scales the learning rate of the positions, in units of the training world: the farthest camera is
at distance 1, and the implementation of Kerbl et al. 2023 adds a tenth."""

Revise = Callable[[Plan], Plan]


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
    stages = Stages(workdir / "stages.json")
    try:
        looks = None if onlookers is None else Looks(onlookers)
        task = Task(capture, workdir, options, choose_kernels(options), emit, cancelled, looks)
        task.out.mkdir(parents=True, exist_ok=True)
        _warn_of_idle_gpu(task)
        emit(StateEvent(state=JobState.sfm))
        cameras = _recover_cameras(task, stages)
        emit(StateEvent(state=JobState.training))
        photos = _load_photos(cameras, loading_size(options, task.kernels), stages)
        with stages.measured("plan"):
            first = _first_gaussians(task, cameras, photos)
            facts = _measure_facts(task, cameras, photos, first)
            plan = _make_plan(task, facts, revise)
        emit(PlanEvent(plan=plan.as_dict()))
        if plan.image_size < max(facts.width, facts.height):
            del photos  # both sizes at once would be the most memory that photos ever take
            photos = _load_photos(cameras, plan.image_size, stages)
        if plan.exposure and facts.light is not None:
            photos = photos.relit(facts.light)
        engine = open_engine(_seeded(first, cameras, photos, plan), plan.kernels)
        training = _train(task, cameras, engine, photos, plan)
    except Cancelled:
        return Outcome("cancelled", workdir / "out")
    emit(StateEvent(state=JobState.exporting))
    _write_files(task, cameras, photos, facts, plan, engine, training, stages)
    return Outcome("succeeded", task.out, training.trained)


@dataclass(frozen=True)
class Task:
    """The arguments of `run`, which describes them, and the kernels chosen for them.

    kernels: the backend of the engine.
    looks: those of the onlookers; None where there are none.
    """

    capture: Path
    workdir: Path
    options: TrainOptions
    kernels: Kernels
    emit: Emit
    cancelled: Callable[[], bool]
    looks: Looks | None

    @property
    def keeps_time_lapse(self) -> bool:
        """Whether snapshots of the training are kept: of the jobs of a service, if nothing else is asked for."""
        asked = self.options.time_lapse
        return asked is Switch.on or (asked is Switch.auto and self.looks is not None)

    @property
    def out(self) -> Path:
        """The folder for what the job leaves."""
        return self.workdir / "out"


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


@dataclass(frozen=True)
class Photos:
    """The photos of both parts of the split as tensors, in the training world."""

    training: list[TrainingView]
    held_out: list[TrainingView]

    @property
    def shown(self) -> TrainingView:
        """The view of previews and of the progress film: a held-out one where there is any."""
        return (self.held_out or self.training)[0]

    def relit(self, light: Light) -> Photos:
        """The photos, with those to train on brought to the light of the photos around them.

        light: of the training photos, in their order, measured at any size of them.

        Held-out photos stay as they are: to fit them to the model would flatter the score.
        """
        changes = zip(self.training, light.departures, strict=True)
        return replace(self, training=[view.relit(departure) for view, departure in changes])


@dataclass(frozen=True)
class Training:
    """A finished training.

    trained: its result.
    events: emits its events and holds its warnings.
    film: the frames of the progress film; None where the options ask for no film.
    lapse: the snapshots of the training; None where none are kept.
    """

    trained: Trained
    events: TrainingEvents
    film: ProgressFilm | None
    lapse: TimeLapse | None


def _warn_of_idle_gpu(task: Task) -> None:
    if task.kernels == "cpu" and task.options.backend is Backend.auto and torch.cuda.is_available():
        task.emit(LogEvent(level="warning", message=f"{absence()} Training runs on the CPU."))


def _recover_cameras(task: Task, stages: Stages) -> Cameras:
    """The cameras that came with the photos or are recovered from them, and which photos are held out."""
    live = None if task.looks is None else LiveCameras(task.looks, task.emit, task.workdir)
    with stages.measured("sfm"):
        scene = posed_scene(
            task.capture, task.workdir, task.options, progress_events(task.emit), task.cancelled, live
        )
    if task.looks is not None and task.looks.seconds:
        stages.add("sfm", -task.looks.seconds)
    parts = honest_split(scene, task.options)
    scene = replace(
        scene,
        left_out=(*scene.left_out, *parts.left_out),
        warnings=(*scene.warnings, *parts.warnings),
    )
    for note in scene.notes:
        task.emit(LogEvent(message=note))
    for warning in scene.warnings:
        task.emit(LogEvent(level="warning", message=warning))
    for sentence in omissions(scene.left_out):
        task.emit(LogEvent(level="warning", message=sentence, about="unused_photos"))
    normalization = Normalization.of(scene)
    world = ExportWorld.of(normalization, scene)
    placement = placement_of(scene, world, (view.name for view in parts.held_out))
    store_placement(placement, task.workdir, task.emit)
    return Cameras(scene, normalization, normalization.apply(scene), parts.training, parts.held_out, world)


def _load_photos(cameras: Cameras, size: int, stages: Stages) -> Photos:
    """All photos, undistorted, with `size` pixels at most on the longer side."""
    with stages.measured("load"):
        training, held_out = (
            [TrainingView.of(photo, cameras.normalization) for photo in load_views(views, size)]
            for views in (cameras.training, cameras.held_out)
        )
    return Photos(training, held_out)


@dataclass(frozen=True)
class First:
    """The Gaussians that training may start from.

    gaussians: all of them, before the plan limits their number.
    model: the assessment of the given model; None where no model was given.
    hull: the visual hull that points were added in, or why there is none; None where none was carved.
    """

    gaussians: Gaussians
    model: GivenModel | None = None
    hull: Hull | NoHull | None = None


def _first_gaussians(task: Task, cameras: Cameras, photos: Photos) -> First:
    """The given model, or Gaussians made from points and in the visual hull of transparent photos, or at random."""
    path = start_model_path(task.capture, task.workdir, task.options)
    if path is not None:
        given = read_given_model(path, cameras.normalization, _most_given(task.options))
        gaussians = given.gaussians
        for note in given.notes:
            task.emit(LogEvent(level="warning", message=f"{path.name}: {note}"))
        if given.count > gaussians.count:
            message = _reduced_message(path, given.count, gaussians.count)
            task.emit(LogEvent(level="warning", message=message))
        start = assess(gaussians, photos.training, antialiased=given.antialiased)
        if start.doubtful:
            task.emit(LogEvent(level="warning", message=_doubt_message(start)))
        return First(gaussians, start)
    world = cameras.world
    targets = [view.full for view in photos.training]
    hull = None
    if any(target.alpha is not None for target in targets):
        hull = visual_hull(targets, resolved(targets[0].rgb[..., 0].numel(), len(targets)))
    if isinstance(hull, Hull):
        return First(hull.gaussians(len(hull.points), world.points, world.colors), hull=hull)
    if len(world.points) >= ENOUGH_POINTS:
        return First(from_points(torch.from_numpy(world.points), torch.from_numpy(world.colors)), hull=hull)
    return First(from_points(*sample_frusta(targets, RANDOM_GAUSSIANS, task.options.seed)), hull=hull)


def _most_given(options: TrainOptions) -> int:
    """Number of Gaussians of a given model that are kept: as many as memory can train, and as the options ask for."""
    most = Plan.gaussians_within(options.max_memory or memory.available() // 2)
    return most if options.max_gaussians is None else min(most, max(options.max_gaussians, LEAST_ASSESSED))


def _reduced_message(path: Path, count: int, kept: int) -> str:
    return (
        f"{path.name} has {count:,} Gaussians, more than this job can hold. Training starts from the {kept:,} most "
        "opaque ones. Set a larger max_gaussians, or use a machine with more memory, to keep more."
    )


def _doubt_message(start: GivenModel) -> str:
    return (
        f"The given model renders the training photos with a PSNR of {start.psnr:.1f} dB, hardly more than a constant "
        f"colour per photo ({start.one_color:.1f} dB). If the model shows another scene, train without the option "
        "start."
    )


def _measure_facts(task: Task, cameras: Cameras, photos: Photos, first: First) -> Facts:
    """What can be measured before training: the scene, its photos, and how fast this machine trains it."""
    pixels = photos.training[0].full.rgb[..., 0].numel()
    most = resolved(pixels, len(photos.training)) if first.model is None else 0
    speed = probe(open_engine(first.gaussians, task.kernels), photos.training, most=most)
    facts = measure(cameras.world, photos.training, len(photos.held_out), speed)
    facts = replace(facts, start=first.model)
    if isinstance(first.hull, Hull):
        facts = replace(facts, hull_points=len(first.hull.points))
    elif first.hull is not None:
        facts = replace(facts, no_hull=first.hull.reason)
    card = describe() if task.kernels == "gpu" else None
    return facts if card is None else replace(facts, memory_available=card.free_bytes)


def _make_plan(task: Task, facts: Facts, revise: Revise) -> Plan:
    """The plan that an earlier attempt stored for the same options; else a new one, which is stored.

    Raises Refusal for an option that cannot be followed with this scene or these kernels.
    """
    stored = task.workdir / "plan.json"
    kept = read_plan(stored, task.options)
    if kept is not None:
        return kept
    try:
        plan = revise(decide(facts, task.options, task.kernels))
    except ValueError as error:
        raise Refusal(
            "option_out_of_range", str(error), advice="Change the option and start again."
        ) from error
    # A checkpoint of another plan cannot be resumed.
    shutil.rmtree(task.workdir / "checkpoints", ignore_errors=True)
    write_plan(stored, task.options, plan)
    return plan


def _seeded(first: First, cameras: Cameras, photos: Photos, plan: Plan) -> Gaussians:
    """The first Gaussians within the plan's limit, with what the plan adds to those made from points."""
    if isinstance(first.hull, Hull):
        added = at_first(len(first.hull.points), plan.max_gaussians)
        gaussians = first.hull.gaussians(added, cameras.world.points, cameras.world.colors)
        return gaussians.most_opaque(plan.max_gaussians)
    gaussians = first.gaussians.most_opaque(plan.max_gaussians)
    if plan.initial != "points":
        return gaussians
    return add_seeds(
        gaussians,
        cameras.world,
        photos.training,
        fill_gaps=plan.gaps,
        add_far_shell=plan.far_shell,
        max_gaussians=plan.max_gaussians,
    )


def _train(task: Task, cameras: Cameras, engine: Engine, photos: Photos, plan: Plan) -> Training:
    """Train to the end of the budget, from the checkpoint of an earlier attempt where there is one."""
    checkpoints = task.workdir / "checkpoints"
    earlier = _resumable(checkpoints, photos)
    film = None
    if task.options.progress_video:
        film = ProgressFilm(task.workdir / "film", photos.shown, plan, anew=earlier is None)
    lapse = None
    if task.keeps_time_lapse:
        lapse = TimeLapse(
            task.workdir / TIME_LAPSE, cameras.exported, anew=earlier is None, antialiased=plan.antialias
        )
    live = None if task.looks is None else LiveScene(task.looks, cameras.exported, plan.antialias)
    events = TrainingEvents(task.emit, task.workdir, plan, photos.shown)
    trained = train(
        engine,
        photos.training,
        photos.held_out,
        plan,
        extent=EXTENT,
        hooks=Hooks(
            progress=events.progress,
            evaluated=events.evaluated,
            warn=events.warn,
            cancelled=task.cancelled,
            checkpoint=lambda snapshot: checkpoint.save(checkpoints, snapshot),
            observers=[observer for observer in (film, lapse, live) if observer is not None],
        ),
        resume_from=earlier,
    )
    return Training(trained, events, film, lapse)


def _resumable(checkpoints: Path, photos: Photos) -> Snapshot | None:
    """The checkpoint of an earlier attempt that trained on the same photos; None without one."""
    snapshot = checkpoint.load(checkpoints)
    names = tuple(view.name for view in photos.training)
    return snapshot if snapshot is not None and snapshot.view_names == names else None


def _write_files(
    task: Task,
    cameras: Cameras,
    photos: Photos,
    facts: Facts,
    plan: Plan,
    engine: Engine,
    training: Training,
    stages: Stages,
) -> None:
    """Write the model, its cameras, the last preview, the film and the report."""
    trained, events = training.trained, training.events
    with stages.measured("export"):
        exported = export(task.out, trained, plan, cameras.exported, photos.held_out)
        write_cameras(
            task.out / "cameras.zip",
            cameras.scene,
            {
                v.name: cameras.exported.camera(v.full.camera).viewmat
                for v in (*trained.views, *photos.held_out)
            },
            cameras.exported.offset,
            frozenset(view.name for view in photos.held_out),
        )
        events.preview(engine, trained.steps)
    if training.film is not None:
        try:
            training.film.develop(task.out / "progress.mp4")
        except (av.FFmpegError, OSError, ValueError) as error:
            # The model is complete: a film that cannot be encoded must not fail the job.
            events.warn(f"The film of the training could not be written: {error}.")
        stages.add("film", training.film.seconds)
    lapse: list[dict[str, Any]] = []
    if training.lapse is not None:
        lapse = training.lapse.publish(task.out)
        stages.add("time_lapse", training.lapse.seconds)
    if task.looks is not None and task.looks.seconds:
        stages.add("live", task.looks.seconds)
    write_report(
        task.out,
        PlannedScene(cameras.scene, facts, plan, photos.held_out),
        FinishedTraining(
            trained, exported, stages.seconds, [*cameras.scene.warnings, *events.warnings], lapse
        ),
        renderer(engine, plan),
    )
