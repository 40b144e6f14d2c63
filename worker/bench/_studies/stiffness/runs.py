"""Trainings at a boost of the rates, by the loop of the product, and what is measured of the Hessian on the way."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from _rows import Row
from torch import Tensor

from splatmill_worker.errors import TrainingFailed
from splatmill_worker.kernels.records import Rates, StepResult
from splatmill_worker.pipeline.training import EXTENT
from splatmill_worker.splat.engine.cpu import CpuEngine
from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.plan.evaluated import evenly
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.plan.rates import RateSchedule
from splatmill_worker.splat.train.loop import Hooks, Trained, train
from splatmill_worker.splat.train.run import TrainingRun

from . import mean_square
from .curvature import COLUMNS, LIMIT, Metric, Objective, Shot, joined, parted, product, shots, start
from .lanczos import Largest, largest
from .scenes import Small, planned

LAST = 50
"""Steps over which the final training loss is averaged."""

ALL = "all groups"

EVERY, PHOTOS, SINGLE = 16, 8, 3
"""Training photos that a state keeps, evenly chosen; those whose mean stands for the loss over all; and those whose
own
Hessians are searched."""


class Watched(CpuEngine):
    """The fused CPU engine, with the rates of single groups multiplied, which keeps losses and counts refused values.

    factors: by group of `Rates`. after: steps with the plan's rates before they count.
    """

    def __init__(self, gaussians: Gaussians, factors: dict[str, float], after: int = 0) -> None:
        self.factors, self.after = factors, after
        self.refused = 0
        self.losses: list[float] = []
        super().__init__(gaussians)

    def train(self, *arguments: Any, rates: Rates, **named: Any) -> StepResult:
        factors = self.factors if len(self.losses) >= self.after else {}
        scaled = replace(rates, **{name: getattr(rates, name) * by for name, by in factors.items()})
        result = super().train(*arguments, rates=scaled, **named)
        self.refused += result.refused
        self.losses.append(result.loss)
        return result


def training(
    small: Small,
    steps: int,
    boost: float,
    seed: int,
    *,
    group: str | None = None,
    by: float = 1.0,
    after: int = 0,
    most: int | None = None,
    probe: Probe | None = None,
) -> Row:
    """The row of one training. group, by, after: the group whose rate, or ALL whose rates, are multiplied by a
    further factor after so many steps."""
    plan, gaussians = planned(small, steps, seed, {"schedule.annealing.boost": boost}, most)
    faster = [] if group is None else list(COLUMNS) if group == ALL else [group]
    engine = Watched(gaussians, dict.fromkeys(faster, by), after)
    warnings: list[str] = []
    if probe is not None:
        probe.begin(plan, warnings)
    row: Row = {
        "part": "runs", "scene": small.name, "longest": small.longest, "steps": steps, "boost": boost, "seed": seed,
        "group": group, "by": by, "after": after,
    }  # fmt: skip
    began = time.process_time()
    try:
        result = train(
            engine,
            small.training,
            small.held_out,
            plan,
            extent=EXTENT,
            hooks=Hooks(warn=warnings.append, observers=[] if probe is None else [probe]),
        )
    except TrainingFailed as failed:
        row |= {"outcome": f"failed: {failed}"}
    else:
        row |= _result(result, engine)
    return row | {
        "refused": engine.refused,
        "warnings": warnings,
        "recoveries": len(warnings),
        "cpu_seconds": round(time.process_time() - began, 2),
    }


def _result(result: Trained, engine: Watched) -> Row:
    """Scores, the last losses, and where the parameters went."""
    gaussians = result.gaussians
    opacity = torch.sigmoid(gaussians.logit_opacities)
    losses = torch.tensor(engine.losses[-LAST:])
    return {
        "outcome": "trained" if result.failure is None else f"failed: {result.failure}",
        "psnr": None if result.held_out is None else round(result.held_out.psnr, 4),
        "ssim": None if result.held_out is None else round(result.held_out.ssim, 5),
        "train_psnr": round(result.on_training.psnr, 4),
        "loss": round(float(losses.mean()), 6),
        "gaussians": gaussians.count,
        "transparent": round(float((opacity < 1 / 255).float().mean()), 4),
        "opaque": round(float((opacity > 0.99).float().mean()), 4),
        "wide": round(float((gaussians.log_scales.amax(1) > 0).float().mean()), 5),
        "far": round(float((gaussians.means.norm(dim=1) > 100).float().mean()), 5),
        "axis_ratio": round(
            float((gaussians.log_scales.amax(1) - gaussians.log_scales.amin(1)).exp().median()), 2
        ),
    }


@dataclass
class Probe:
    """Measures the Hessian at shares of the budget; an observer of the training loop.

    rows: what was measured so far, without what names the run.
    """

    small: Small
    shares: Sequence[float]
    tolerance: float = 0.05
    rows: list[Row] = field(default_factory=list)

    def begin(self, plan: Plan, warnings: list[str]) -> None:
        """A training with this plan begins, which puts a sentence into `warnings` at each roll-back."""
        self.plan, self.warnings, self._next = plan, warnings, 0

    def is_due(self, run: TrainingRun) -> bool:
        return self._next < len(self.shares) and run.progress >= self.shares[self._next]

    def observe(self, run: TrainingRun) -> None:
        progress, step = run.progress, run.state.step
        self._next += 1
        state = State.of(self.small, run.engine, self.plan, progress, step, 0.5 ** len(self.warnings))
        self.rows.append(
            {"part": "curvature", "share": progress, "step": step, **measure(state, self.tolerance)}
        )


@dataclass(frozen=True)
class State:
    """A training between two steps.

    x: parameters [N, 59], float64. moments: Adam's, [N, 59] each. rates: of the next step, whose number is step + 1.
    photos: the loss on each of EVERY photos. mean: the loss over PHOTOS of them. metric: Adam's.
    """

    x: Tensor
    moments: tuple[Tensor, Tensor]
    rates: Rates
    step: int
    photos: list[Objective]
    mean: Objective
    metric: Metric

    @staticmethod
    def of(small: Small, engine: Engine, plan: Plan, progress: float, step: int, scale: float) -> State:
        """What `engine` holds; `scale`: the factor on all rates after roll-backs."""
        schedule = plan.schedule
        rates = RateSchedule(EXTENT, schedule.annealing, scale).at(progress)
        moments = engine.moments()
        all_shots = shots(evenly(small.training, EVERY), plan, schedule.reduction(step + 1))

        def over(some: list[Shot]) -> Objective:
            return Objective(some, degree=schedule.degree, antialias=plan.antialias)

        return State(
            joined(engine.parameters()),
            moments,
            rates,
            step,
            [over([shot]) for shot in all_shots],
            over(evenly(all_shots, PHOTOS)),
            Metric.of(moments[1], rates, step),
        )


def measure(state: State, tolerance: float = 0.05) -> Row:
    """How near the state is to both limits, in which directions, and what the next step does.

    ratio: largest eigenvalue of the mean loss over 38; beyond: estimated share of its eigenvalues above 38.
    photos: largest eigenvalue of single photos over 38.
    stochastic: the nearest that any of the directions found comes to growing in the mean square, a lower bound
        (`mean_square.ratio`); seen_by: how many photos curve that direction, as (sum h)^2 / (sum h^2).
    shared_by: how many Gaussians that direction moves, as 1 over the sum of their squared shares.
    alone: `stochastic` with one group moving only.
    """

    def top(objective: Objective, metric: Metric, tolerance: float, most: int, least: int = 1) -> Largest:
        apply = product(objective.gradient, state.x, metric)
        return largest(apply, start(metric), tolerance=tolerance, most=most, least=least)

    def over_photos(u: Tensor, metric: Metric) -> Tensor:
        return torch.tensor(
            [float((u * product(photo.gradient, state.x, metric)(u)).sum()) for photo in state.photos]
        )

    of_mean = top(state.mean, state.metric, tolerance, 40, 20)
    searched = evenly(state.photos, SINGLE)
    singles = [top(photo, state.metric, tolerance, 25) for photo in searched]
    candidates = [of_mean.vector, *(single.vector for single in singles)]
    curvatures = [over_photos(u, state.metric) for u in candidates]
    ratios = [mean_square.ratio(h) for h in curvatures]
    worst = max(range(len(ratios)), key=lambda k: ratios[k])
    sharpest = searched[max(range(len(singles)), key=lambda k: singles[k].value)]
    alone = {}
    for name in COLUMNS:
        metric = state.metric.within(name)
        if bool((metric.root > 0).any()):
            u = top(sharpest, metric, 0.1, 12).vector
            alone[name] = mean_square.ratio(over_photos(u, metric))
    h = curvatures[worst]
    return {
        "gaussians": len(state.x),
        "ratio": of_mean.value / LIMIT,
        "error": of_mean.error / LIMIT,
        "products": of_mean.products,
        "values": int((state.metric.root > 0).sum()),
        "beyond": of_mean.share_above(LIMIT),
        "groups": _by_group(of_mean.vector),
        "photos": [single.value / LIMIT for single in singles],
        "stochastic": ratios[worst],
        "seen_by": float(h.sum() ** 2 / (h * h).sum()),
        "stochastic_groups": _by_group(candidates[worst]),
        "shared_by": float(1.0 / (candidates[worst] ** 2).sum(1).square().sum()),
        "alone": alone,
        **next_steps(state),
    }


def _by_group(u: Tensor) -> dict[str, float]:
    """The share of each group in the square of a unit vector [N, 59]."""
    return {name: float(u[:, columns].square().sum()) for name, columns in COLUMNS.items()}


def next_steps(state: State) -> Row:
    """What the next step does, whichever photo it is on.

    along: the curvature of the mean loss along the step, over 38. gain: the fall of the mean loss over what its
    gradient promises for this step, with sums over the photos: 1 where steps are short, 0 where a step gains nothing.
    own: the same of the photo that the step is on.
    """
    slope, before = state.mean.gradient(state.x), state.mean.value(state.x)
    fall = promised = curved = length = own_fall = own_promised = 0.0
    for photo in evenly(state.photos, SINGLE):
        (shot,) = photo.shots
        engine = CpuEngine(Gaussians(**parted(state.x)))
        engine.replace(parted(state.x), *state.moments)
        engine.train_photo(
            shot.viewmat, shot.K, shot.photo,
            degree=photo.degree, rates=state.rates, step=state.step + 1, background=shot.background,
            mask=shot.mask, antialias=photo.antialias,
        )  # fmt: skip
        moved = (joined(engine.parameters()) - state.x) * (state.metric.root > 0)
        after = state.x + moved
        fall += before - state.mean.value(after)
        promised -= float((slope * moved).sum())
        own_fall += photo.value(state.x) - photo.value(after)
        own_promised -= float((photo.gradient(state.x) * moved).sum())
        curved += float(((state.mean.gradient(after) - slope) * moved).sum())
        held = state.metric.root > 0
        length += float((moved[held] / state.metric.root[held]).square().sum())
    return {
        "along": curved / length / LIMIT,
        "gain": fall / promised if promised > 0 else None,
        "own": own_fall / own_promised if own_promised > 0 else None,
    }
