"""The whole path of a capture: images -> cameras -> plan -> train -> evaluate -> export."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import av
import torch

from splatmill.schema import (
    Backend,
    Event,
    JobState,
    LogEvent,
    MetricEvent,
    PlanEvent,
    PreviewEvent,
    ProgressEvent,
    StateEvent,
    TrainOptions,
)
from splatmill_worker.capture import cameras_of, held_out_of, kernels_of, start_file
from splatmill_worker.errors import Cancelled, Refusal
from splatmill_worker.images import load_views
from splatmill_worker.kernels.gpu.device import absence, describe
from splatmill_worker.scene import Normalization, Scene, View
from splatmill_worker.splat.engine.open import open_engine
from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.picture import save_jpeg
from splatmill_worker.splat.plan.decide import decide, loading_size
from splatmill_worker.splat.plan.facts import Facts, measure
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.plan.probe import probe
from splatmill_worker.splat.report.export import Frame, export
from splatmill_worker.splat.report.progress_film import ProgressFilm
from splatmill_worker.splat.report.report import write_report
from splatmill_worker.splat.report.stages import Stages
from splatmill_worker.splat.start.completion import completed
from splatmill_worker.splat.start.frusta import RANDOM_GAUSSIANS, in_frusta
from splatmill_worker.splat.start.given_model import Start, judge, strongest
from splatmill_worker.splat.start.given_model import read as read_start
from splatmill_worker.splat.start.points import ENOUGH_POINTS, from_points
from splatmill_worker.splat.train import checkpoint
from splatmill_worker.splat.train.loop import Hooks, Tick, Trained, drawer, evaluation_background, train
from splatmill_worker.splat.train.run import Row
from splatmill_worker.splat.views import TrainingView

Emit = Callable[[Event], None]

EXTENT = 1.1
"""Radius of the cameras in the training world, where the farthest is at 1, with the paper's tenth added."""


@dataclass(frozen=True)
class Outcome:
    """How a run ended: "succeeded" with files in `out`, or "cancelled" with a checkpoint to go on from."""

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
    revise: Callable[[Plan], Plan] = lambda plan: plan,
) -> Outcome:
    """Train a scene from `capture` and leave model.ply, cameras.json and the reports in `workdir/out`.

    `workdir` survives attempts: what is there is gone on from. Events are emitted as things happen; states are
    sfm, training and exporting, the final one is the caller's to say. `revise` changes the plan once it is made,
    which is how an ablation takes one decision back. Raises Refusal, sfm.SfmFailed and
    TrainingFailed, each with a sentence for the person who asked.
    """
    out = workdir / "out"
    out.mkdir(parents=True, exist_ok=True)
    stages = Stages(workdir / "stages.json")
    try:
        kernels = kernels_of(options)
        if kernels == "cpu" and options.backend is Backend.auto and torch.cuda.is_available():
            emit(LogEvent(level="warning", message=f"{absence()} Training runs on the CPU."))

        emit(StateEvent(state=JobState.sfm))
        with stages.measured("sfm"):
            scene = cameras_of(capture, workdir, options, _sfm_progress(emit), cancelled)
        for note in scene.notes:
            emit(LogEvent(message=note))
        for name, reason in scene.left_out:
            emit(LogEvent(level="warning", message=f"{name} is left out: {reason}"))

        emit(StateEvent(state=JobState.training))
        with stages.measured("load"):
            frame = Normalization.of(scene)
            world = frame.apply(scene)
            train_views, test_views = held_out_of(scene, options)
            size = loading_size(options, kernels)
            views, held_out = _loaded(train_views, size, frame), _loaded(test_views, size, frame)
        with stages.measured("plan"):
            start = _start(capture, workdir, options, frame, views)
            if start is not None and start.facts.doubtful:
                emit(LogEvent(level="warning", message=_doubt(start.facts)))
            gaussians = _first_gaussians(world, views, options) if start is None else start.gaussians
            known = None if start is None else start.facts
            plan, facts = _plan(world, views, held_out, gaussians, known, options, workdir, revise)
            gaussians = strongest(gaussians, plan.max_gaussians)
        emit(PlanEvent(plan=plan.as_dict()))
        if plan.image_size < max(facts.width, facts.height):
            with stages.measured("load"):
                views, held_out = (
                    _loaded(train_views, plan.image_size, frame),
                    _loaded(test_views, plan.image_size, frame),
                )

        if plan.initial == "points":
            gaussians = completed(
                gaussians,
                world,
                views,
                fill_gaps=plan.gaps,
                add_far_shell=plan.far_shell,
                max_gaussians=plan.max_gaussians,
            )
        engine = open_engine(gaussians, plan.kernels)
        resumable = _resumable(workdir, views)
        film = None
        if options.progress_video:
            anew = resumable is None
            film = ProgressFilm(workdir / "film", (held_out or views)[0], plan, anew=anew)
        teller = _Teller(emit, workdir, plan, (held_out or views)[0])
        trained = train(
            engine,
            views,
            held_out,
            plan,
            extent=EXTENT,
            hooks=Hooks(
                tick=teller.tick,
                measured=teller.measured,
                warn=teller.warn,
                cancelled=cancelled,
                checkpoint=lambda state: checkpoint.save(workdir / "checkpoints", state),
                watcher=film,
            ),
            resume_from=resumable,
        )
    except Cancelled:
        return Outcome("cancelled", out)

    views = list(trained.views)
    emit(StateEvent(state=JobState.exporting))
    with stages.measured("export"):
        home = Frame.of(frame, scene)
        written = export(out, trained, plan, home, views, held_out)
        teller.preview(engine, trained.steps)
    if film is not None:
        try:
            film.develop(out / "progress.mp4")
        except (av.FFmpegError, OSError, ValueError) as error:
            # The model is worth more than its film.
            teller.warn(f"The film of the training could not be written: {error}.")
        stages.add("film", film.seconds)
    write_report(
        out, trained, plan, facts, scene, stages, written, home, engine, views, held_out, teller.warnings
    )
    return Outcome("succeeded", out, trained)


@dataclass(frozen=True)
class _Model:
    """The model to start from, in the training world, and what is known of it."""

    gaussians: Gaussians
    facts: Start


def _start(
    capture: Path, workdir: Path, options: TrainOptions, frame: Normalization, views: list[TrainingView]
) -> _Model | None:
    """The model given: a file beside the capture's poses, or the one that was fetched into `workdir`."""
    path = start_file(capture, workdir, options)
    if path is None:
        return None
    gaussians = read_start(path, frame)
    return _Model(gaussians, judge(gaussians, views))


def _doubt(start: Start) -> str:
    return (
        f"The model given shows the training photos at {start.psnr:.1f} dB, hardly better than one colour per photo "
        f"({start.one_color:.1f} dB). If it is of another scene, train without it."
    )


def _loaded(views: tuple[View, ...], size: int, frame: Normalization) -> list[TrainingView]:
    return [TrainingView.of(photo, frame) for photo in load_views(views, size)]


def _first_gaussians(world: Scene, views: list[TrainingView], options: TrainOptions) -> Gaussians:
    if len(world.points) >= ENOUGH_POINTS:
        points, colors = torch.from_numpy(world.points), torch.from_numpy(world.colors)
    else:
        targets = [view.full for view in views]
        points, colors = in_frusta(targets, RANDOM_GAUSSIANS, options.seed)
    return from_points(points, colors)


def _plan(
    world: Scene,
    views: list[TrainingView],
    held_out: list[TrainingView],
    gaussians: Gaussians,
    start: Start | None,
    options: TrainOptions,
    workdir: Path,
    revise: Callable[[Plan], Plan],
) -> tuple[Plan, Facts]:
    """The plan, made once: an attempt that goes on keeps the one it started with."""
    kernels = kernels_of(options)
    stored = workdir / "plan.json"
    facts = measure(world, views, len(held_out), probe(open_engine(gaussians, kernels), views))
    card = describe() if kernels == "gpu" else None
    if card is not None:
        facts = replace(facts, memory_available=card.free_bytes)
    facts = replace(facts, start=start)
    if stored.is_file():
        kept = json.loads(stored.read_text())
        if kept["options"] == options.model_dump(mode="json"):
            # A plan of another version has other fields; then one is made anew.
            with suppress(KeyError, TypeError):
                return Plan.from_dict(kept["plan"]), facts
    try:
        plan = revise(decide(facts, options, kernels))
    except ValueError as error:
        raise Refusal(
            "option_out_of_range", str(error), advice="Change the option and start again."
        ) from error
    # What an attempt with another plan left cannot be gone on from.
    shutil.rmtree(workdir / "checkpoints", ignore_errors=True)
    part = stored.with_suffix(".part")
    part.write_text(
        json.dumps({"options": options.model_dump(mode="json"), "plan": plan.as_dict(whole=True)})
    )
    part.replace(stored)
    return plan, facts


def _resumable(workdir: Path, views: list[TrainingView]) -> dict[str, Any] | None:
    """The state of an earlier attempt at the same photos."""
    state = checkpoint.load(workdir / "checkpoints")
    return state if state is not None and state["views"] == [view.name for view in views] else None


def _sfm_progress(emit: Emit) -> Callable[[str, int, int, str], None]:
    def tell(stage: str, done: int, total: int, note: str) -> None:
        emit(ProgressEvent(stage=stage, done=done, total=total or None, note=note or None))

    return tell


class _Teller:
    """Turns what training says into events, and keeps the preview picture up to date."""

    def __init__(self, emit: Emit, workdir: Path, plan: Plan, view: TrainingView) -> None:
        self._emit, self._workdir, self._plan, self._view = emit, workdir, plan, view
        self._last: Row | None = None
        self.warnings: list[str] = []

    def tick(self, tick: Tick) -> None:
        self._emit(
            ProgressEvent(
                stage="training",
                done=tick.step,
                total=tick.steps,
                step=tick.step,
                loss=tick.loss,
                psnr=None if self._last is None else self._last.psnr,
                ssim=None if self._last is None else self._last.ssim,
                gaussians=tick.gaussians,
                seconds=tick.seconds,
                eta=tick.eta,
            )
        )

    def measured(self, row: Row, engine: Engine) -> None:
        self._last = row
        self._emit(
            MetricEvent(
                seconds=row.seconds,
                step=row.step,
                loss=row.loss,
                psnr=row.psnr,
                ssim=row.ssim,
                gaussians=row.gaussians,
                memory=row.memory,
                train_psnr=row.train_psnr,
                train_ssim=row.train_ssim,
            )
        )
        self.preview(engine, row.step)

    def warn(self, message: str) -> None:
        self.warnings.append(message)
        self._emit(LogEvent(level="warning", message=message))

    def preview(self, engine: Engine, step: int) -> None:
        color = drawer(engine, self._plan)(self._view.full, evaluation_background(self._plan, [self._view]))
        save_jpeg(self._workdir / "out" / "preview.jpg", color)
        self._emit(PreviewEvent(path="out/preview.jpg", step=step))
