"""Training: takes steps until the budget is spent, evaluates on the way, and rolls back after numerical failures."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from splatmill_worker.errors import Cancelled, FailureName, TrainingFailed
from splatmill_worker.splat.engine.open import gaussians_of
from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.evaluate import Score
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.train.curve import CurvePoint, last_gain
from splatmill_worker.splat.train.disagreement import Disagreement, Look
from splatmill_worker.splat.train.evaluations import Evaluations, corrected
from splatmill_worker.splat.train.poses import Poses, mean_depth
from splatmill_worker.splat.train.renderer import render_view
from splatmill_worker.splat.train.run import TrainingRun
from splatmill_worker.splat.train.snapshot import Snapshot
from splatmill_worker.splat.views import TrainingView

MAX_RECOVERIES = 3
"""Roll-backs of a run; the next failure ends it."""

PROGRESS_SECONDS = 0.5
"""Seconds between two reports of progress."""

CHECKPOINT_SECONDS = 20.0
"""Seconds between two checkpoints, at most."""

FIRST_CHECKPOINT_SECONDS = 2.5
"""Seconds until the first checkpoint. From there to CHECKPOINT_SECONDS, each is as far from the last as that one is
from the beginning, so that an attempt which is lost early loses half of its work at most."""

FLAT_TAIL = 0.1
"""Share of the time spent so far in which the rates fall to their ends once doublings gain too little."""


@dataclass(frozen=True)
class TrainingProgress:
    """Where a run stands.

    step: training steps so far.
    steps: steps of the whole run, estimated under a time budget.
    loss: training loss of the last step.
    gaussians: how many the scene has.
    seconds: training time so far.
    eta: training seconds to come, estimated.
    """

    step: int
    steps: int
    loss: float
    gaussians: int
    seconds: float
    eta: float


class Observer(Protocol):
    """Looks at the scene at moments of its own choice, while the training clock stands still."""

    def is_due(self, progress: float) -> bool:
        """Whether to look at the scene now, at this share of the budget."""

    def observe(self, engine: Engine, progress: float, seconds: float, step: int) -> None:
        """Look at what `engine` holds after `step` steps, `seconds` into the training."""


@dataclass(frozen=True)
class Hooks:
    """What training calls while it runs.

    progress: every PROGRESS_SECONDS.
    evaluated: with every new point of the curve.
    warn: with a sentence, when a numerical failure was rolled back.
    cancelled: before every step; training ends when it returns True.
    checkpoint: with a snapshot to store, every `checkpoint_seconds`, sooner at first (FIRST_CHECKPOINT_SECONDS), and on
        a cancellation; None: never.
    checkpoint_seconds: seconds between two checkpoints, at most.
    observers: look at the scene, each at moments of its own.
    """

    progress: Callable[[TrainingProgress], None] = lambda _: None
    evaluated: Callable[[CurvePoint, Engine], None] = lambda _point, _engine: None
    warn: Callable[[str], None] = lambda _: None
    cancelled: Callable[[], bool] = lambda: False
    checkpoint: Callable[[Snapshot], None] | None = None
    checkpoint_seconds: float = CHECKPOINT_SECONDS
    observers: Sequence[Observer] = ()


@dataclass(frozen=True)
class Trained:
    """The result of a training run.

    gaussians: the scene, in the training world, on the CPU.
    curve: the evaluations on the way.
    held_out: score of the held-out views at the end; None where there are none.
    on_training: score of an even choice of the training views at the end.
    steps: training steps.
    seconds: training time, without evaluations and checkpoints.
    evaluate_seconds: time of all evaluations of this attempt, and of the comparison of the photos.
    stopped: why the run ended, a clause or, after a failure, a sentence.
    failure: the failure that ended the run with its last good state; None where none did.
    recoveries: roll-backs.
    views: the training views with their cameras as the run left them.
    cameras_moved: median correction of the cameras, pixels; None where they are not refined.
    validation: names of the training views that were set aside for decisions.
    disagreements: how far each training photo disagrees with those around it, the largest first; without `validation`.
    """

    gaussians: Gaussians
    curve: tuple[CurvePoint, ...]
    held_out: Score | None
    on_training: Score
    steps: int
    seconds: float
    evaluate_seconds: float
    stopped: str
    failure: TrainingFailed | None
    recoveries: int
    views: tuple[TrainingView, ...]
    cameras_moved: float | None
    validation: tuple[str, ...] = ()
    disagreements: tuple[Disagreement, ...] = ()


def train(
    engine: Engine,
    views: Sequence[TrainingView],
    held_out: Sequence[TrainingView],
    plan: Plan,
    *,
    extent: float,
    hooks: Hooks | None = None,
    resume_from: Snapshot | None = None,
) -> Trained:
    """Optimise the scene that `engine` holds until it shows `views`, as `plan` says.

    held_out: views to evaluate on for the curve and the result, which may be none. No decision reads them.
    extent: radius of the cameras in the training world, the unit of the position rate.
    resume_from: what `hooks.checkpoint` was given in an earlier attempt with the same views and plan.

    Evaluations and checkpoints are not on the training clock. Raises TrainingFailed where no usable state was reached,
    and Cancelled when `hooks.cancelled` returns True.
    """
    hooks = hooks or Hooks()
    render_view(engine, plan, views[0])  # code is loaded and memory allocated before the clock starts
    poses = None
    if plan.pose_refinement:
        poses = Poses(views, _scene_depth(engine, views, plan))
        engine.keep_pose_gradient = True
    run = TrainingRun(engine, plan, views, extent, poses=poses, warn=hooks.warn)
    if resume_from is not None:
        run.resume(resume_from)
    validation = tuple(run.views[index].name for index in sorted(run.set_aside))
    evaluations, look = Evaluations(run, held_out), Look(run)
    stopped, failure = "", None
    began = last_progress = last_checkpoint = time.monotonic()
    while not stopped:
        if run.set_aside and (run.shortened or evaluations.last_is_next):
            run.train_on_all()
        if hooks.cancelled():
            if hooks.checkpoint is not None and run.step > 0:
                hooks.checkpoint(run.snapshot())
            raise Cancelled
        try:
            run.advance()
        except TrainingFailed as failed:
            if run.recoveries >= MAX_RECOVERIES or failed.name is FailureName.empty_scene:
                if not run.ever_visible or not run.curve or not run.restore_last_good():
                    raise
                stopped, failure = f"{failed}", failed
                break
            run.roll_back(failed)
        if evaluations.due:
            with run.clock.stopped():
                hooks.evaluated(evaluations.evaluate(), engine)
            stopped = _reason_to_stop(run)
        if look.is_due:
            with run.clock.stopped():
                look.take()
        for observer in hooks.observers:
            if observer.is_due(run.progress):
                with run.clock.stopped():
                    observer.observe(engine, run.progress, run.clock.seconds, run.step)
        now = time.monotonic()
        if now - last_progress >= PROGRESS_SECONDS:
            last_progress = now
            hooks.progress(_progress(run))
        gap = min(hooks.checkpoint_seconds, max(FIRST_CHECKPOINT_SECONDS, last_checkpoint - began))
        if hooks.checkpoint is not None and not stopped and now - last_checkpoint >= gap:
            with run.clock.stopped():
                hooks.checkpoint(run.snapshot())
            last_checkpoint = time.monotonic()
    return _result(run, evaluations, look, stopped, failure, validation)


def _result(
    run: TrainingRun,
    evaluations: Evaluations,
    look: Look,
    stopped: str,
    failure: TrainingFailed | None,
    validation: tuple[str, ...],
) -> Trained:
    """What the run ends with. After a failure, the scene is not that of the last point, and is evaluated anew."""
    seconds = run.clock.seconds
    run.engine.keep_pose_gradient = False
    if failure is not None:
        evaluations.final = None
    final = evaluations.finish()
    found = look.finish()
    return Trained(
        gaussians=gaussians_of(run.engine).padded(run.plan.schedule.degree),
        curve=tuple(run.curve),
        held_out=final.held_out,
        on_training=final.on_training,
        steps=run.step,
        seconds=seconds,
        evaluate_seconds=evaluations.seconds + look.seconds,
        stopped=stopped,
        failure=failure,
        recoveries=run.recoveries,
        views=corrected(run),
        cameras_moved=None if run.poses is None else run.poses.pixels_moved(),
        validation=validation,
        disagreements=found,
    )


def _scene_depth(engine: Engine, views: Sequence[TrainingView], plan: Plan) -> float:
    """Median, over about eight views, of the mean depth that they show before training."""
    depths = []
    for view in views[:: max(1, len(views) // 8)]:
        target = view.full
        _, alpha, depth = engine.forward(
            target.viewmat,
            target.K,
            target.camera.width,
            target.camera.height,
            degree=0,
            antialias=plan.antialias,
        )
        depths.append(mean_depth(depth, alpha))
    return sorted(depths)[len(depths) // 2]


def _reason_to_stop(run: TrainingRun) -> str:
    """Why the run ends after its last evaluation; empty where it continues. May cut the budget."""
    plan, gain = run.plan, last_gain(run.curve)
    if run.progress >= 1.0:
        why = (
            f"another doubling of the steps would gain less than {plan.least_gain:g} dB"
            if run.shortened
            else "the budget is spent"
        )
        if gain is None or not plan.stops_when_flat:
            return why
        return f"{why}; the last one gained {gain:.2f} dB on the validation photos"
    reached = run.curve[-1].validation_psnr
    if plan.target_psnr is not None and reached is not None and reached >= plan.target_psnr:
        return f"the validation photos ({len(run.set_aside)}) reached {reached:.2f} dB"
    if plan.stops_when_flat and not run.shortened and gain is not None and gain < plan.least_gain:
        run.shorten(FLAT_TAIL)
    return ""


def _progress(run: TrainingRun) -> TrainingProgress:
    progress, seconds = run.progress, run.clock.seconds
    total = run.step if progress <= 0 else round(run.step / progress)
    eta = seconds * (1.0 - progress) / max(progress, 1e-6)
    return TrainingProgress(run.step, max(run.step, total), run.loss, run.engine.count, seconds, eta)
