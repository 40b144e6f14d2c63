"""A training run: one photo per step, densification, and the roll-back after a numerical failure."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from splatmill_worker.errors import FailureName, TrainingFailed
from splatmill_worker.kernels.records import Rates
from splatmill_worker.splat.engine.protocol import Engine, StepResult
from splatmill_worker.splat.plan.budget import Budget, Clock
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.plan.rates import RateSchedule, boost_of
from splatmill_worker.splat.train.curve import validated
from splatmill_worker.splat.train.density.densify import densify
from splatmill_worker.splat.train.dropout import dropout
from splatmill_worker.splat.train.health import LossHealth, not_finite
from splatmill_worker.splat.train.pace import Pace
from splatmill_worker.splat.train.poses import Poses
from splatmill_worker.splat.train.renderer import fixed_background
from splatmill_worker.splat.train.snapshot import RunState, Snapshot
from splatmill_worker.splat.train.validation import validation_indices
from splatmill_worker.splat.views import TrainingView

SNAPSHOT_SHARE = 0.04
"""Share of the budget between two snapshots to roll back to."""

MEMORY_SHRINK = 0.8
"""Share of the Gaussians that is kept after memory ran out."""

AHEAD = 8
"""Photos that are read from the disk while steps are taken on those before them: of a megapixel each, 24 MB."""

STREAM = 1_000_003
"""Steps between the random choices of two seeds of a run: longer than any run."""


class TrainingRun:
    """A scene in training: the engine that holds it, and what the run has reached.

    engine: the scene, its optimiser and the kernels.
    plan: what was decided before training.
    views: the training views; `poses` and `upcoming` hold their indices.
    set_aside: indices of the views that decisions are made by, and which no step is taken on meanwhile.
    extent: radius of the cameras in the training world, the unit of the position rate.
    poses: corrections of the cameras; None where they are taken as given.
    warn: gets a sentence at each roll-back.
    state: what the run has reached.
    clock: training seconds.
    loss: training loss of the last step; NaN before the first.
    reduction: factor by which the photos of the last step were reduced; 0 before the first.
    health: judges the loss.
    pace: seconds per step.
    stopped: why the run has ended, a clause; empty while it runs.
    last_good: the snapshot to roll back to; None before the first.
    best: the scene that has shown the validation photos best; None before the first, and without any such photos.
    """

    def __init__(
        self,
        engine: Engine,
        plan: Plan,
        views: Sequence[TrainingView],
        extent: float,
        *,
        poses: Poses | None = None,
        warn: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.engine, self.plan, self.views, self.extent = engine, plan, views, extent
        self.set_aside = frozenset(validation_indices(len(views), plan.validation or 0))
        self.poses, self.warn = poses, warn
        self.state = RunState(plan.schedule.budget, plan.max_gaussians)
        self.clock = Clock()
        self.loss = math.nan
        self.reduction = 0
        self.health = LossHealth()
        self.pace = Pace(plan.schedule.expected_steps)
        self.stopped = ""
        self.last_good: Snapshot | None = None
        self.best: Snapshot | None = None
        self._random = torch.Generator().manual_seed(plan.seed)

    @property
    def progress(self) -> float:
        """Share of the budget that is spent, 0 to 1."""
        return self.state.budget.progress(self.state.step, self.clock.seconds)

    @property
    def longest(self) -> Budget:
        """The budget as long as it may still become: the longest that the plan allows, until the last photos to decide
        by are trained on.
        """
        longest, budget = self.plan.schedule.longest, self.state.budget
        if longest is None or budget.steps is None or self.state.shortened or not self.set_aside:
            return budget
        return replace(budget, steps=max(budget.steps, longest))

    def advance(self) -> None:
        """Take one step, and densify where the schedule says so. Raises TrainingFailed for a numerical failure."""
        schedule = self.plan.schedule
        progress = self.progress
        if self.last_good is None or (
            progress - self.state.budget.progress(self.last_good.state.step, self.last_good.seconds)
            >= SNAPSHOT_SHARE
            and self.health.near_lowest
        ):
            self.last_good = self._checked_snapshot()
        self.state.step += 1
        reduction = schedule.reduction(self.state.step)
        if reduction != self.reduction:
            self.reduction = reduction
            for view in self.views:
                view.forget_reduced()  # coarse photos do not come again
            self.health.expect_rise(self.state.step)
        index = self._next_view()
        for coming in reversed(self.state.upcoming[-AHEAD:]):
            self.views[coming].read_ahead()
        rates = self.rates(progress)
        began = self.clock.seconds
        result = self._step(index, rates)
        self.loss = result.loss
        if reduction == 1:
            self.pace.record(self.clock.seconds - began)
        if self.poses is not None and self.engine.pose_gradient is not None:
            self.poses.update(index, self.engine.pose_gradient, progress, self.state.rate_scale)
        self.state.ever_visible |= result.visible > 0
        self.health.check(self.state.step, result.loss, result.visible)
        # Scores cost time, so they are summed only while Gaussians are added.
        self.engine.keep_scores = self.plan.densify and progress < schedule.densify_until
        if self.plan.densify and schedule.densifies(self.state.step, progress):
            self._densify()

    def rates(self, progress: float) -> Rates:
        """Learning rates at `progress`, 0 to 1. They are scaled to the number of steps: under a time budget to the
        measured one, and where the budget was doubled to the new one.
        """
        annealing, budget = self.plan.schedule.annealing, self.state.budget
        if annealing.boost is None:
            steps = self.pace.steps(budget, self.state.step, self.clock.seconds)
            annealing = replace(annealing, boost=boost_of(steps))
        elif budget.steps is not None:
            annealing = replace(annealing, boost=min(annealing.boost, boost_of(budget.steps)))
        extent = self.extent * self.plan.schedule.position_scale
        return RateSchedule(extent, annealing, self.state.rate_scale).at(progress)

    @property
    def validated(self) -> list[tuple[int, float]]:
        """Step and validation PSNR, dB, of the points of the curve that decisions compare."""
        return validated(self.state.curve, since=self.plan.schedule.reduced_until)

    def keep_best(self) -> None:
        """Keep the scene if it has just shown the validation photos better than any before."""
        scores = self.validated
        if scores and scores[-1] == (self.state.step, max(psnr for _, psnr in scores)):
            self.best = self.snapshot().stored()

    def go_back(self) -> None:
        """Restore the best scene, where one was kept: what came after it is over-fitting."""
        if self.best is not None:
            self._restore(self.best)
            self.state.limited = self.best.state.limited
            self.last_good = self.best
            self.health.expect_rise(self.state.step)

    def shorten(self, tail: float) -> None:
        """End after another `tail` of what was spent so far: rates fall to their ends in that time."""
        self.state.budget = self.state.budget.ending_at(self.progress, tail)
        self.state.shortened = True

    def double(self) -> bool:
        """Double the budget, up to the longest that the plan allows; False where it stays as it is."""
        longest, steps = self.plan.schedule.longest, self.state.budget.steps
        if longest is None or steps is None or steps >= longest or self.state.shortened:
            return False
        self.state.budget = replace(self.state.budget, steps=min(2 * steps, longest))
        self.health.expect_rise(self.state.step)  # rates rise to those of the longer run
        return True

    def train_on_all(self) -> None:
        """Take steps on the photos that were set aside too: no decision is made by them any more."""
        self.set_aside = frozenset()

    def roll_back(self, failure: TrainingFailed) -> None:
        """Restore the last good snapshot and go on with half the learning rates, or with fewer Gaussians where
        memory ran out. Raises `failure` where there is no snapshot yet.
        """
        if self.last_good is None:
            raise failure
        self.state.recoveries += 1
        if failure.name is FailureName.memory:
            self.state.limited = True
            self.state.max_gaussians = max(1, int(MEMORY_SHRINK * self.engine.count))
            self.last_good = self.last_good.most_opaque(self.state.max_gaussians)
            self.best = None
            measure = f"with at most {self.state.max_gaussians} Gaussians"
        else:
            self.state.rate_scale *= 0.5
            measure = "with half the learning rates"
        self._restore(self.last_good)
        self.health = LossHealth(
            lowest=self.last_good.lowest_loss, checked_from=self.state.step + len(self.views)
        )
        self.warn(f"{failure} Training went back to the last good state and continues {measure}.")

    def restore_last_good(self) -> bool:
        """Restore what was optimised from the last good snapshot; False where there is none."""
        if self.last_good is None:
            return False
        self._restore(self.last_good)
        return True

    def snapshot(self) -> Snapshot:
        """The state of the run now."""
        exp_avg, exp_avg_sq = self.engine.moments()
        return Snapshot(
            parameters=self.engine.parameters(),
            exp_avg=exp_avg,
            exp_avg_sq=exp_avg_sq,
            poses=None if self.poses is None else self.poses.state(),
            state=replace(self.state),
            seconds=self.clock.seconds,
            random=self._random.get_state(),
            view_names=tuple(view.name for view in self.views),
            lowest_loss=self.health.lowest,
            best=self.best,
        )

    def resume(self, snapshot: Snapshot) -> None:
        """Go on from `snapshot`. Densification scores, the pace and the health of the loss start anew."""
        self._restore(snapshot)
        self.state = replace(snapshot.state)
        self.best = snapshot.best
        self.clock = Clock(snapshot.seconds)
        self._random.set_state(snapshot.random)
        self.health.expect_rise(self.state.step)

    def _restore(self, snapshot: Snapshot) -> None:
        """Put back what was optimised: Gaussians, moments and cameras."""
        self.engine.replace(snapshot.parameters, snapshot.exp_avg, snapshot.exp_avg_sq)
        if self.poses is not None and snapshot.poses is not None:
            self.poses.restore(snapshot.poses)

    def _checked_snapshot(self) -> Snapshot:
        """A snapshot to roll back to. Raises TrainingFailed where parameters are not finite."""
        snapshot = self.snapshot()
        bad = sum(not_finite(value) for value in snapshot.parameters.values())
        if bad:
            raise TrainingFailed(
                FailureName.non_finite, f"{bad} parameters are not finite.", step=self.state.step
            )
        return snapshot

    def _step(self, index: int, rates: Rates) -> StepResult:
        """One optimisation step on photo number `index`, at the reduction of this step."""
        target = self.views[index].reduced(self.reduction)
        background = self._background()
        share = self.plan.schedule.left_out(self.state.step / max(1, len(self.views) - len(self.set_aside)))
        try:
            with dropout(self.engine.logit_opacities, share, seed=self.plan.seed * STREAM + self.state.step):
                return self.engine.train_photo(
                    target.viewmat if self.poses is None else self.poses.viewmat(index),
                    target.K,
                    target.rgb,
                    degree=self.plan.schedule.degree,
                    rates=rates,
                    step=self.state.step,
                    background=background,
                    alpha=target.alpha,
                    mask=target.mask,
                    antialias=self.plan.antialias,
                    key=(index, self.reduction),
                    part_of=target.part_of,
                )
        except MemoryError as short:
            raise TrainingFailed(FailureName.memory, f"{short}", step=self.state.step) from short

    def _background(self) -> Tensor:
        """RGB [3] behind this step's photo. A random one keeps training from hiding holes in the surface."""
        if self.plan.background == "random":
            return torch.rand(3, generator=self._random)
        return fixed_background(self.plan)

    def _next_view(self) -> int:
        """The index of the next photo: all that are not set aside once in random order, then all of them again."""
        state = self.state
        if not state.upcoming:
            order = torch.randperm(len(self.views), generator=self._random).tolist()
            state.upcoming = tuple(index for index in order if index not in self.set_aside)
        *rest, index = state.upcoming
        state.upcoming = tuple(rest)
        return index

    def _densify(self) -> None:
        allowed = min(self.plan.max_gaussians, self.state.max_gaussians)
        if self.plan.max_memory is not None:
            watched = self.plan.validation is not None
            allowed = min(allowed, self.plan.gaussians_within(self.plan.max_memory, best=watched))
        within = self.plan.schedule.decay_within
        try:
            change = densify(
                self.engine,
                allowed=allowed,
                opacity_decay=self.plan.schedule.opacity_decay,
                decay_within=math.inf if within is None else within,
            )
            self.state.limited = change.unsplit > 0
        except MemoryError as short:
            raise TrainingFailed(FailureName.memory, f"{short}", step=self.state.step) from short
        if self.engine.count == 0:
            symptom = "every Gaussian became transparent and was removed."
            raise TrainingFailed(FailureName.empty_scene, symptom, step=self.state.step)
