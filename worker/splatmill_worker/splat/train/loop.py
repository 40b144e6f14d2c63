"""Training: runs until the budget is spent, measures on the way, and recovers from numerical failures."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch
from torch import Tensor

from splatmill_worker.errors import Cancelled, FailureName, TrainingFailed
from splatmill_worker.splat.engine.open import gaussians_of
from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.evaluate import Score, evaluate, judged_over
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.machine import resident_memory
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.train.exposure import Exposure
from splatmill_worker.splat.train.poses import Poses, typical_depth
from splatmill_worker.splat.train.run import Row, Run
from splatmill_worker.splat.views import Target, TrainingView

MAX_RECOVERIES = 3
TICK_SECONDS = 0.5
MEASURED_AT = (0.02, 0.04, 0.07, 0.11, 0.16, 0.22, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
"""Shares of the budget at which the held-out views are rendered: close together where the curve is steep."""

ALSO_MEASURED = 4
"""Training views, evenly chosen, that are rendered for each point of the curve beside the held-out ones."""

FLAT_GAIN = 0.02
"""dB on the held-out views; training that gains less over FLAT_SHARE of its time is not worth it."""

FLAT_SHARE, FLAT_ROWS = 0.4, 3

FLAT_TAIL = 0.1


@dataclass(frozen=True)
class Tick:
    """Where the run stands between two points of the curve; eta in seconds."""

    step: int
    steps: int
    loss: float
    gaussians: int
    seconds: float
    eta: float


class Watcher(Protocol):
    """Who looks at the scene at moments of its own, while the training clock stands still."""

    def due(self, progress: float) -> bool:
        """Whether to look at this share of the budget."""

    def take(self, engine: Engine, progress: float, seconds: float) -> None:
        """Look, `seconds` into the training."""


@dataclass
class Hooks:
    """What a caller watches and decides. `checkpoint` gets plain values and tensors to store."""

    tick: Callable[[Tick], None] = lambda _: None
    measured: Callable[[Row, Engine], None] = lambda _row, _engine: None
    warn: Callable[[str], None] = lambda _: None
    cancelled: Callable[[], bool] = lambda: False
    checkpoint: Callable[[dict[str, Any]], None] | None = None
    checkpoint_seconds: float = 20.0
    watcher: Watcher | None = None


@dataclass(frozen=True)
class Trained:
    """What came out. `gaussians` are in the training world; `stopped` says why the run ended.

    `views` are the training views with their cameras as the run left them, `cameras_moved` by how many pixels (the
    median); None where the plan leaves cameras as they come.
    """

    gaussians: Gaussians
    rows: tuple[Row, ...]
    held_out: Score | None
    on_training: Score
    steps: int
    seconds: float
    evaluate_seconds: float
    stopped: str
    failure: TrainingFailed | None
    recoveries: int
    views: Sequence[TrainingView]
    cameras_moved: float | None


@dataclass
class _Measuring:
    """Seconds spent on evaluation, and which points of the curve are done."""

    seconds: float = 0.0
    done: int = 0
    since: float = field(default_factory=time.perf_counter)


def train(
    engine: Engine,
    views: Sequence[TrainingView],
    held_out: Sequence[TrainingView],
    plan: Plan,
    *,
    extent: float,
    hooks: Hooks | None = None,
    resume_from: dict[str, Any] | None = None,
) -> Trained:
    """Optimise what `engine` holds until it shows `views`, as `plan` says.

    extent: radius of the cameras in the training world, the unit of the position rate. resume_from: a state that
    `hooks.checkpoint` was given by an earlier attempt with the same plan. Evaluation and checkpoints are not on
    the training clock. Raises TrainingFailed when nothing usable was reached, Cancelled on request.
    """
    hooks = hooks or Hooks()
    exposure = Exposure(len(views)) if plan.exposure else None
    warm_up(engine, views[0], plan)
    poses = None
    if plan.pose_refinement:
        poses = Poses(views, _depth_seen(engine, views, plan))
        engine.keep_pose_gradient = True
    run = Run(engine, plan, views, extent, exposure, hooks.warn, poses)
    if resume_from is not None:
        run.resume(resume_from)
    # The last point is always measured: an attempt may end after its last step and before its model is written.
    done = min(sum(share <= run.progress for share in MEASURED_AT), len(MEASURED_AT) - 1)
    measuring = _Measuring(done=done)
    stopped, failure = "", None
    last_tick = last_checkpoint = time.monotonic()
    while not stopped:
        if hooks.cancelled():
            # Whoever asks a run to end may have it go on later.
            if hooks.checkpoint is not None and run.step > 0:
                hooks.checkpoint(run.state())
            raise Cancelled
        try:
            run.advance()
        except TrainingFailed as named:
            if run.recoveries >= MAX_RECOVERIES or named.name is FailureName.empty_scene:
                if not run.ever_saw or not run.rows or not run.restore_good():
                    raise
                stopped, failure = f"{named}", named
                break
            run.recover(named)
        if run.progress >= MEASURED_AT[measuring.done]:
            with run.clock.stopped():
                row = _measure(run, held_out, measuring)
                hooks.measured(row, engine)
            stopped = _enough(run, plan)
        if hooks.watcher is not None and hooks.watcher.due(run.progress):
            with run.clock.stopped():
                hooks.watcher.take(engine, run.progress, run.clock.seconds)
        now = time.monotonic()
        if now - last_tick >= TICK_SECONDS:
            last_tick = now
            hooks.tick(_tick(run))
        if hooks.checkpoint is not None and not stopped and now - last_checkpoint >= hooks.checkpoint_seconds:
            with run.clock.stopped():
                hooks.checkpoint(run.state())
            last_checkpoint = time.monotonic()
    seconds = run.clock.seconds
    started = time.perf_counter()
    draw = drawer(engine, plan)
    backdrop = evaluation_background(plan, views)
    final = evaluate(draw, held_out, backdrop) if held_out else None
    engine.keep_pose_gradient = False
    seen_from = list(views) if poses is None else poses.corrected(views)
    sample = seen_from[:: max(1, len(views) // 16)]
    on_training = evaluate(draw, sample, backdrop)
    return Trained(
        gaussians_of(engine).padded(plan.schedule.degree),
        tuple(run.rows),
        final,
        on_training,
        run.step,
        seconds,
        measuring.seconds + time.perf_counter() - started,
        stopped,
        failure,
        run.recoveries,
        seen_from,
        None if poses is None else poses.pixels_moved(),
    )


def drawer(engine: Engine, plan: Plan) -> Callable[[Target, Tensor], Tensor]:
    """Renders targets with what the engine holds now."""

    def draw(target: Target, background: Tensor) -> Tensor:
        camera = target.camera
        color, _, _ = engine.forward(
            target.viewmat,
            target.K,
            camera.width,
            camera.height,
            degree=plan.schedule.degree,
            background=background,
            antialias=plan.antialias,
        )
        return color

    return draw


def evaluation_background(plan: Plan, views: Sequence[TrainingView]) -> Tensor:
    """What published results are judged on: white behind transparent photos, black behind opaque ones.

    A colour that the plan fixes is kept: the Gaussians know no other.
    """
    if plan.background == "random":
        return judged_over(views)
    return torch.full((3,), 1.0 if plan.background == "white" else 0.0)


def _depth_seen(engine: Engine, views: Sequence[TrainingView], plan: Plan) -> float:
    """Mean depth of what some of the views show before training."""
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
        depths.append(typical_depth(depth, alpha))
    return sorted(depths)[len(depths) // 2]


def warm_up(engine: Engine, view: TrainingView, plan: Plan) -> None:
    """Touch code and memory once before the clock starts; changes nothing."""
    drawer(engine, plan)(view.full, evaluation_background(plan, [view]))


def _measure(run: Run, held_out: Sequence[TrainingView], measuring: _Measuring) -> Row:
    started = time.perf_counter()
    while measuring.done < len(MEASURED_AT) and run.progress >= MEASURED_AT[measuring.done]:
        measuring.done += 1
    draw, backdrop = drawer(run.engine, run.plan), evaluation_background(run.plan, run.views)
    score = evaluate(draw, held_out, backdrop) if held_out else None
    seen_from = run.views if run.poses is None else run.poses.corrected(run.views)
    on_training = evaluate(draw, seen_from[:: math.ceil(len(seen_from) / ALSO_MEASURED)], backdrop)
    row = Row(
        run.clock.seconds,
        run.step,
        run.loss,
        None if score is None else score.psnr,
        None if score is None else score.ssim,
        run.engine.count,
        resident_memory(),
        on_training.psnr,
        on_training.ssim,
    )
    run.rows.append(row)
    measuring.seconds += time.perf_counter() - started
    return row


def _enough(run: Run, plan: Plan) -> str:
    """Why the run ends here; empty when it goes on."""
    if run.progress >= 1.0:
        return "the held-out curve became flat" if run.shortened else "the budget is spent"
    reached = run.rows[-1].psnr
    if plan.target_psnr is not None and reached is not None and reached >= plan.target_psnr:
        return f"the held-out views reached {reached:.2f} dB"
    if plan.stops_when_flat and not run.shortened and _flat(run.rows):
        run.shorten(FLAT_TAIL)
    return ""


def _flat(rows: Sequence[Row]) -> bool:
    """Whether none of the last rows, over FLAT_SHARE of the time, gained FLAT_GAIN on the best one before them.

    One row is no evidence: the curve dips where Gaussians were just added or the photos became larger.
    """
    scores = [(row.seconds, row.psnr) for row in rows if row.psnr is not None]
    if not scores or rows[-1].step < 500:
        return False
    since = (1.0 - FLAT_SHARE) * scores[-1][0]
    before = [psnr for seconds, psnr in scores if seconds <= since]
    after = [psnr for seconds, psnr in scores if seconds > since]
    return bool(before) and len(after) >= FLAT_ROWS and max(after) < max(before) + FLAT_GAIN


def _tick(run: Run) -> Tick:
    progress, seconds = run.progress, run.clock.seconds
    total = run.step if progress <= 0 else round(run.step / progress)
    eta = seconds * (1.0 - progress) / max(progress, 1e-6)
    return Tick(run.step, max(run.step, total), run.loss, run.engine.count, seconds, eta)
