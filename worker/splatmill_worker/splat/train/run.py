"""A training run in flight: one photo at a time, and whatever is due after it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from splatmill_worker.errors import FailureName, TrainingFailed
from splatmill_worker.kernels import ops
from splatmill_worker.kernels.records import Rates
from splatmill_worker.splat.engine.protocol import Engine, StepResult
from splatmill_worker.splat.plan.budget import Budget, Clock
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.plan.rates import RateSchedule, boost_of
from splatmill_worker.splat.train.density import clone_split
from splatmill_worker.splat.train.exposure import Exposure
from splatmill_worker.splat.train.health import Health
from splatmill_worker.splat.train.pace import Pace
from splatmill_worker.splat.train.poses import Poses
from splatmill_worker.splat.views import Target, TrainingView

SNAPSHOT_SHARE = 0.04
"""Of the budget between two copies of a good state: 2 % of the time at most, and little is lost."""

MEMORY_SHRINK = 0.8
"""Of the Gaussians there were when memory ran out."""


@dataclass(frozen=True)
class Row:
    """One point of error against run time.

    psnr and ssim: on the held-out views, None where there are none. train_psnr and train_ssim: on a few of those
    trained on; what they gain while the others lose is learnt by heart. memory: resident bytes.
    """

    seconds: float
    step: int
    loss: float
    psnr: float | None
    ssim: float | None
    gaussians: int
    memory: int | None = None
    train_psnr: float | None = None
    train_ssim: float | None = None


@dataclass
class Run:
    """Everything that changes while training. `extent` is the radius of the cameras in the training world."""

    engine: Engine
    plan: Plan
    views: Sequence[TrainingView]
    extent: float
    exposure: Exposure | None
    warn: Callable[[str], None]
    poses: Poses | None = None
    clock: Clock = field(default_factory=Clock)
    step: int = 0
    loss: float = math.nan
    rows: list[Row] = field(default_factory=list)
    recoveries: int = 0
    rate_scale: float = 1.0
    reduction: int = 0
    order: list[int] = field(default_factory=list)
    health: Health = field(default_factory=Health)
    shortened: bool = False
    ever_saw: bool = False

    def __post_init__(self) -> None:
        self.budget: Budget = self.plan.schedule.budget
        self.pace = Pace(self.plan.schedule.expected_steps)
        self.random = torch.Generator().manual_seed(self.plan.seed)
        self._good: tuple[dict[str, Tensor], Tensor, Tensor] | None = None
        self._good_poses: dict[str, Tensor] | None = None
        self._good_exposure: dict[str, Any] | None = None
        self._good_progress = -math.inf
        self._good_level = math.inf
        self._most = self.plan.max_gaussians
        self._fixed = torch.full((3,), 1.0 if self.plan.background == "white" else 0.0)

    @property
    def progress(self) -> float:
        """Share of the budget that is spent, 0..1."""
        return self.budget.progress(self.step, self.clock.seconds)

    def advance(self) -> None:
        """One step, and densification where it is due. Raises TrainingFailed by name."""
        schedule = self.plan.schedule
        progress = self.progress
        if self._good is None or (progress - self._good_progress >= SNAPSHOT_SHARE and self.health.well):
            self._remember(progress)
        self.step += 1
        reduction = schedule.reduction(self.step)
        if reduction != self.reduction:
            self.reduction = reduction
            self.health.disturbed(self.step)
        number = self._next_view()
        target = self.views[number].reduced(reduction)
        rates = self.rates(progress)
        began = self.clock.seconds
        try:
            if self.poses is not None:
                target = target._replace(viewmat=self.poses.viewmat(number))
            if self.exposure is None:
                result = self._plain_step(number, target, rates)
            else:
                result = self._exposed_step(self.exposure, number, target, rates)
        except MemoryError as short:
            raise TrainingFailed(FailureName.memory, f"{short}", step=self.step) from short
        self.loss = result.loss
        if reduction == 1:
            self.pace.timed(self.clock.seconds - began)
        if self.poses is not None and self.engine.pose_gradient is not None:
            self.poses.update(number, self.engine.pose_gradient, progress, self.rate_scale)
        self.ever_saw |= result.visible > 0
        self.health.watch(self.step, result.loss, result.visible)
        # What nobody will read is not summed.
        self.engine.keep_scores = self.plan.densify and progress < schedule.densify_until
        if self.plan.densify and schedule.densifies(self.step, progress):
            self._densify()

    def rates(self, progress: float) -> Rates:
        """Of a step at `progress`; in a time budget as long as suits the steps that it turns out to hold."""
        annealing = self.plan.schedule.annealing
        if annealing.boost is None:
            steps = self.pace.steps(self.budget, self.step, self.clock.seconds)
            annealing = replace(annealing, boost=boost_of(steps))
        return RateSchedule(self.extent, annealing, self.rate_scale).at(progress)

    def recover(self, failure: TrainingFailed) -> None:
        """Back to the last good state, with steps half as long."""
        if self._good is None:
            raise failure
        self.recoveries += 1
        if failure.name is FailureName.memory:
            self._shrink(failure)
            return
        self.rate_scale *= 0.5
        self._go_back(self._good)
        self.health = Health(lowest=self._good_level, calm_from=self.step + len(self.views))
        self.warn(f"{failure} Went back to the last good state, with steps half as long.")

    def _shrink(self, failure: TrainingFailed) -> None:
        """Go on with four fifths of the Gaussians, the most opaque ones, and never have more again."""
        self._most = max(1, int(MEMORY_SHRINK * self.engine.count))
        assert self._good is not None
        parameters, exp_avg, exp_avg_sq = self._good
        order = torch.argsort(parameters["logit_opacities"], descending=True, stable=True)
        kept = torch.sort(order[: self._most]).values
        self._good = (
            {name: value[kept] for name, value in parameters.items()},
            exp_avg[kept],
            exp_avg_sq[kept],
        )
        self._go_back(self._good)
        self.health = Health(lowest=self._good_level, calm_from=self.step + len(self.views))
        self.warn(f"{failure} Went back to the last good state, and on with at most {self._most} Gaussians.")

    def shorten(self, tail: float) -> None:
        """End after another `tail` of what was spent so far: rates fall to their ends in that time."""
        self.budget = self.budget.ending_at(self.progress, tail)
        self.shortened = True

    def restore_good(self) -> bool:
        """Back to the last good state without going on; False when there is none."""
        if self._good is None:
            return False
        self._go_back(self._good)
        return True

    def _go_back(self, good: tuple[dict[str, Tensor], Tensor, Tensor]) -> None:
        self.engine.replace(*good)
        if self.poses is not None and self._good_poses is not None:
            self.poses.restore(self._good_poses)
        if self.exposure is not None and self._good_exposure is not None:
            self.exposure.restore(self._good_exposure)

    def background(self) -> Tensor:
        """RGB [3] behind this step's photo."""
        return torch.rand(3, generator=self.random) if self.plan.background == "random" else self._fixed

    def state(self) -> dict[str, Any]:
        """Everything a later attempt needs to go on, as plain values and tensors."""
        exp_avg, exp_avg_sq = self.engine.moments()
        return {
            "parameters": self.engine.parameters(),
            "exp_avg": exp_avg,
            "exp_avg_sq": exp_avg_sq,
            "step": self.step,
            "seconds": self.clock.seconds,
            "rows": [asdict(row) for row in self.rows],
            "recoveries": self.recoveries,
            "rate_scale": self.rate_scale,
            "order": self.order,
            "random": self.random.get_state(),
            "views": [view.name for view in self.views],
            "exposure": None if self.exposure is None else self.exposure.state(),
            "poses": None if self.poses is None else self.poses.state(),
            "budget": asdict(self.budget),
            "shortened": self.shortened,
            "most": self._most,
            "ever_saw": self.ever_saw,
        }

    def resume(self, state: dict[str, Any]) -> None:
        """Go on from `state`; densification scores and what the health watch remembers start again."""
        self.engine.replace(state["parameters"], state["exp_avg"], state["exp_avg_sq"])
        self.step = state["step"]
        self.clock = Clock(state["seconds"])
        self.rows = [Row(**row) for row in state["rows"]]
        self.recoveries = state["recoveries"]
        self.rate_scale = state["rate_scale"]
        self.order = list(state["order"])
        self.random.set_state(state["random"])
        self.budget = Budget(**state["budget"])
        self.shortened = state["shortened"]
        self._most = state["most"]
        self.ever_saw = state["ever_saw"]
        self.health.disturbed(self.step)
        if self.exposure is not None:
            self.exposure.restore(state["exposure"])
        if self.poses is not None:
            self.poses.restore(state["poses"])

    def _plain_step(self, number: int, target: Target, rates: Rates) -> StepResult:
        background = self.background()
        return self.engine.train_photo(
            target.viewmat,
            target.K,
            target.over(background),
            degree=self.plan.schedule.degree,
            rates=rates,
            step=self.step,
            background=background,
            mask=target.mask,
            antialias=self.plan.antialias,
            key=(number, self.reduction) if target.alpha is None else None,
        )

    def _exposed_step(self, exposure: Exposure, number: int, target: Target, rates: Rates) -> StepResult:
        background = self.background()
        color, alpha, _ = self.engine.forward(
            target.viewmat,
            target.K,
            target.camera.width,
            target.camera.height,
            degree=self.plan.schedule.degree,
            background=background,
            antialias=self.plan.antialias,
        )
        color = color.detach().clone().requires_grad_()
        seen = exposure.applied(number, color)
        photo = target.over(background).to(seen.device)
        mask = None if target.mask is None else target.mask.to(seen.device)
        loss = ops.loss(seen, photo, mask=mask, backend=self.plan.kernels)
        (loss + exposure.penalty(number).to(loss.device)).backward()  # type: ignore[no-untyped-call]  # torch's own gap
        if bool(torch.isfinite(loss)):  # else the step is about to be undone
            exposure.update(self.rate_scale)
        assert color.grad is not None
        self.engine.backward_update(color.grad, rates=rates, step=self.step)
        return StepResult(float(loss.detach()), int(bool((alpha > 0).any())), 0)

    def _next_view(self) -> int:
        """Every photo once in random order, then again."""
        if not self.order:
            self.order = torch.randperm(len(self.views), generator=self.random).tolist()
        return self.order.pop()

    def _densify(self) -> None:
        allowed = min(self.plan.max_gaussians, self._most)
        if self.plan.max_memory is not None:
            allowed = min(allowed, self.plan.gaussians_within(self.plan.max_memory))
        within = self.plan.schedule.decay_within
        try:
            clone_split.densify(
                self.engine,
                self.random,
                extent=self.extent,
                allowed=allowed,
                opacity_decay=self.plan.schedule.opacity_decay,
                decay_within=math.inf if within is None else within,
            )
        except MemoryError as short:
            raise TrainingFailed(FailureName.memory, f"{short}", step=self.step) from short
        if self.engine.count == 0:
            seen = "every Gaussian became transparent and was removed."
            raise TrainingFailed(FailureName.empty_scene, seen, step=self.step)

    def _remember(self, progress: float) -> None:
        parameters = self.engine.parameters()
        spoilt = sum(int((~torch.isfinite(value)).sum()) for value in parameters.values())
        if spoilt:
            raise TrainingFailed(
                FailureName.non_finite, f"{spoilt} parameters are not finite.", step=self.step
            )
        self._good = (parameters, *self.engine.moments())
        self._good_poses = None if self.poses is None else self.poses.state()
        self._good_exposure = None if self.exposure is None else self.exposure.state()
        self._good_progress = progress
        self._good_level = self.health.lowest
