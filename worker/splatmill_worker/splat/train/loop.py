"""Training: takes steps until the budget is spent, is observed on the way, and rolls back after numerical failures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from splatmill_worker.errors import Cancelled, FailureName, TrainingFailed
from splatmill_worker.splat.engine.open import gaussians_of
from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.evaluate import Score
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.train.curve import CurvePoint
from splatmill_worker.splat.train.disagreement import Disagreement, Look
from splatmill_worker.splat.train.evaluations import Evaluations, corrected
from splatmill_worker.splat.train.observers import (
    CHECKPOINT_SECONDS,
    Checkpoints,
    Observer,
    ProgressReports,
    TrainingProgress,
)
from splatmill_worker.splat.train.poses import Poses, scene_depth
from splatmill_worker.splat.train.renderer import render_view
from splatmill_worker.splat.train.run import TrainingRun
from splatmill_worker.splat.train.snapshot import Snapshot
from splatmill_worker.splat.views import TrainingView

MAX_RECOVERIES = 3
"""Roll-backs of a run; the next failure ends it."""


@dataclass(frozen=True)
class Hooks:
    """What training calls while it runs.

    progress: now and then (`ProgressReports`).
    evaluated: with every new point of the curve.
    evaluating: with each held-out view that is evaluated after the last step: how many so far, and of how many.
    warn: with a sentence, when a numerical failure was rolled back.
    cancelled: before every step; training ends when it returns True.
    checkpoint: with a snapshot to store, now and then (`Checkpoints`) and on a cancellation; None: never.
    checkpoint_seconds: seconds between two checkpoints, at most.
    observers: others that observe the run.
    compares: whether the photos are compared, for `Trained.disagreements`.
    """

    progress: Callable[[TrainingProgress], None] = lambda _: None
    evaluated: Callable[[CurvePoint, Engine], None] = lambda _point, _engine: None
    evaluating: Callable[[int, int], None] = lambda _done, _total: None
    warn: Callable[[str], None] = lambda _: None
    cancelled: Callable[[], bool] = lambda: False
    checkpoint: Callable[[Snapshot], None] | None = None
    checkpoint_seconds: float = CHECKPOINT_SECONDS
    observers: Sequence[Observer] = ()
    compares: bool = True


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
        Empty where they are not compared.
    limited: whether the last densification would have added more Gaussians than it was allowed, or none was made since
        training began with as many as it may have.
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
    limited: bool = False


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
        poses = Poses(views, scene_depth(engine, views, plan))
        engine.keep_pose_gradient = True
    run = TrainingRun(engine, plan, views, extent, poses=poses, warn=hooks.warn)
    if resume_from is not None:
        run.resume(resume_from)
    validation = tuple(run.views[index].name for index in sorted(run.set_aside))
    evaluations = Evaluations(run, held_out, hooks.evaluated, hooks.evaluating)
    look = Look(run) if hooks.compares else None
    observers: list[Observer] = [ProgressReports(hooks.progress), evaluations]
    observers += [*([] if look is None else [look]), *hooks.observers]
    if hooks.checkpoint is not None:
        observers.append(Checkpoints(hooks.checkpoint, hooks.checkpoint_seconds))
    failure = None
    while not run.stopped:
        if run.set_aside and (run.state.shortened or evaluations.decided):
            run.train_on_all()
        if hooks.cancelled():
            if hooks.checkpoint is not None and run.state.step > 0:
                hooks.checkpoint(run.snapshot())
            raise Cancelled
        failure = _advance(run)
        if failure is not None:
            break
        for observer in observers:
            if observer.is_due(run):
                with run.clock.stopped():
                    observer.observe(run)
    return _result(run, evaluations, look, failure, validation)


def _advance(run: TrainingRun) -> TrainingFailed | None:
    """Take one step, or roll back from its failure; returns the failure that the run ends with, in its last good state.

    Raises TrainingFailed where no usable state was reached.
    """
    try:
        run.advance()
    except TrainingFailed as failed:
        state = run.state
        if state.recoveries >= MAX_RECOVERIES or failed.name is FailureName.empty_scene:
            if not state.ever_visible or not state.curve or not run.restore_last_good():
                raise
            return failed
        run.roll_back(failed)
    return None


def _result(
    run: TrainingRun,
    evaluations: Evaluations,
    look: Look | None,
    failure: TrainingFailed | None,
    validation: tuple[str, ...],
) -> Trained:
    """What the run ends with. After a failure, the scene is not that of the last point, and is evaluated anew."""
    seconds = run.clock.seconds
    run.engine.keep_pose_gradient = False
    if failure is not None:
        evaluations.final = None
    final = evaluations.finish()
    disagreements = () if look is None else look.finish()
    return Trained(
        gaussians=gaussians_of(run.engine).padded(run.plan.schedule.degree),
        curve=run.state.curve,
        held_out=final.held_out,
        on_training=final.on_training,
        steps=run.state.step,
        seconds=seconds,
        evaluate_seconds=evaluations.seconds + (0.0 if look is None else look.seconds),
        stopped=run.stopped if failure is None else f"{failure}",
        failure=failure,
        recoveries=run.state.recoveries,
        views=corrected(run),
        cameras_moved=None if run.poses is None else run.poses.pixels_moved(),
        validation=validation,
        disagreements=disagreements,
        limited=run.state.limited or started_full(run.plan),
    )


def started_full(plan: Plan) -> bool:
    """Whether none are added because training begins with as many Gaussians as are allowed, and not by an option."""
    return not plan.densify and "densify" not in plan.forced
