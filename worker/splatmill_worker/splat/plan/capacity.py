"""Decisions on size: the number of steps that the budget allows, and the largest number of Gaussians."""

from __future__ import annotations

import math
from typing import NamedTuple

from splatmill.schema import PRESET_STEPS, Preset, TrainOptions
from splatmill_worker.kernels.gpu.device import largest_budget
from splatmill_worker.splat.plan.budget import Budget
from splatmill_worker.splat.plan.facts import Facts, Speed
from splatmill_worker.splat.plan.plan import Kernels, Plan
from splatmill_worker.splat.plan.reasons import Reasons

GAUSSIANS_PER_ROOT_STEP = 1550.0
"""Gaussians that a run can train, per square root of its number of steps (decisions: GAUSSIANS_PER_ROOT_STEP)."""

PIXELS_PER_GAUSSIAN = 50
"""Pixels of all training photos for each Gaussian that they resolve (decisions: PIXELS_PER_GAUSSIAN)."""

ASSUMED_SPEED = Speed(per_pixel=3e-8, per_gaussian=1e-7)
"""Speed of a machine that was not probed."""


class Capacity(NamedTuple):
    """The size of a run.

    budget: its limits in steps and seconds.
    steps: the number of steps that the budget is expected to allow.
    max_gaussians: the largest number of Gaussians.
    """

    budget: Budget
    steps: int
    max_gaussians: int


class _Limits(NamedTuple):
    """Limits on the number of Gaussians that do not depend on the number of steps.

    photos: number that the photos resolve.
    memory: number that fits in memory.
    overall: limit of every plan of this scene, whatever its number of steps.
    """

    photos: int
    memory: int
    overall: int


def decide_capacity(
    facts: Facts,
    options: TrainOptions,
    kernels: Kernels,
    reasons: Reasons,
    *,
    initial: int,
    pixels: float,
) -> Capacity:
    """The budget of a run, and the largest number of Gaussians that it trains within that budget.

    initial: number of Gaussians before the first step.
    pixels: number of pixels of a photo at the training size.
    """
    limits = _limits(facts, options, kernels, pixels, initial)
    budget, steps = _budget(options, facts.speed or ASSUMED_SPEED, pixels, initial, limits, reasons)
    return Capacity(budget, steps, _max_gaussians(facts, options, limits, steps, pixels, initial, reasons))


def decide_densification(
    options: TrainOptions, capacity: Capacity, reasons: Reasons, *, initial: int
) -> bool:
    """Whether Gaussians are added in training."""
    most = capacity.max_gaussians
    if initial >= most:
        because = f"Training starts with {initial} Gaussians, as many as are allowed."
    else:
        because = f"Training starts with {initial} Gaussians, and {most} are allowed."
    return reasons.switch("densify", options.densify, initial < most, because)


def resolved(pixels: float, views: int) -> int:
    """Gaussians that so many training photos of so many pixels resolve."""
    return round(pixels * views / PIXELS_PER_GAUSSIAN)


def _limits(facts: Facts, options: TrainOptions, kernels: Kernels, pixels: float, initial: int) -> _Limits:
    by_photos = resolved(pixels, facts.views)
    if kernels == "gpu":
        photo_bytes = round(3 * pixels * (facts.views + facts.held_out))
        by_memory = largest_budget(options.max_memory or facts.memory_available, round(pixels), photo_bytes)
    else:
        by_memory = Plan.gaussians_within(options.max_memory or facts.memory_available // 2)
    overall = max(min(by_photos, by_memory), min(initial, by_memory))
    if options.max_gaussians is not None:
        overall = min(overall, options.max_gaussians)
    return _Limits(by_photos, by_memory, overall)


def _budget(
    options: TrainOptions, speed: Speed, pixels: float, initial: int, limits: _Limits, reasons: Reasons
) -> tuple[Budget, int]:
    """The budget, and the number of steps that it is expected to allow."""
    if options.time_budget is not None:
        return _time_budget(options, options.time_budget, speed, pixels, initial, limits, reasons)
    if options.steps is not None:
        reasons.option("budget")
        reasons.chosen["schedule"] = f"The option steps asks for {options.steps} steps."
        return Budget(options.steps), options.steps
    # A run with a target ends once the target is reached, so the longest preset is no longer than needed.
    preset = Preset.quality if options.target_psnr is not None else options.preset
    steps = PRESET_STEPS[preset]
    reasons.chosen["budget"] = f"No budget was given; the preset {preset.value} allows {steps} steps."
    reasons.chosen["schedule"] = reasons.chosen["budget"]
    return Budget(steps), steps


def _time_budget(
    options: TrainOptions,
    seconds: float,
    speed: Speed,
    pixels: float,
    initial: int,
    limits: _Limits,
    reasons: Reasons,
) -> tuple[Budget, int]:
    affordable = _affordable_steps(seconds, speed, pixels, initial, limits.overall)
    steps = affordable if options.steps is None else min(affordable, options.steps)
    reasons.option("budget")
    reasons.chosen["schedule"] = (
        f"{seconds:g} s at {1e9 * speed.per_pixel:.0f} ns per pixel and {1e9 * speed.per_gaussian:.0f} ns per Gaussian "
        f"allow about {affordable} steps"
        + ("." if steps == affordable else f", of which the option steps asks for {steps}.")
    )
    return Budget(options.steps, seconds), steps


def _affordable_steps(seconds: float, speed: Speed, pixels: float, initial: int, most: int) -> int:
    """Steps in `seconds` when the number of Gaussians grows with the steps from `initial`, up to `most`.

    Each is charged as the last one: that early steps have fewer Gaussians and smaller photos, and that photos of a
    trained scene take longer than those of the probe, make up for one another (decisions: forecast).
    """

    def fits(steps: int) -> bool:
        gaussians = min(most, max(initial, _trainable(steps)))
        return steps * speed.step(pixels, gaussians) <= seconds

    few, many = 10, 10**7
    while few + 1 < many:
        middle = (few + many) // 2
        few, many = (middle, many) if fits(middle) else (few, middle)
    return few


def _trainable(steps: int) -> int:
    """How many Gaussians `steps` steps can train."""
    return round(GAUSSIANS_PER_ROOT_STEP * math.sqrt(steps))


def _max_gaussians(
    facts: Facts,
    options: TrainOptions,
    limits: _Limits,
    steps: int,
    pixels: float,
    initial: int,
    reasons: Reasons,
) -> int:
    trainable = _trainable(steps)
    most = max(min(trainable, limits.photos, limits.memory), min(initial, limits.memory))
    if options.max_gaussians is not None:
        most = min(options.max_gaussians, max(most, min(limits.photos, limits.memory)))
        if most == options.max_gaussians:
            reasons.option("max_gaussians")
            return most
    because = {
        trainable: f"About {steps} steps can train {trainable} Gaussians.",
        limits.photos: f"{facts.views} photos of {round(pixels)} pixels resolve {limits.photos} Gaussians.",
        limits.memory: f"Memory holds {limits.memory} Gaussians.",
    }
    reasons.chosen["max_gaussians"] = because.get(
        most,
        f"Training starts with {initial} Gaussians, more than the steps can train or the photos resolve.",
    )
    return most
