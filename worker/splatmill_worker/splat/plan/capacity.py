"""Decisions on size: the number of steps that the budget allows, and the largest number of Gaussians."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

from splatmill.schema import (
    PHOTOS_PER_VALIDATION,
    PRESET_LONGEST,
    PRESET_VISITS,
    Preset,
    TrainOptions,
    format_bytes,
    format_duration,
    preset_steps,
)
from splatmill_worker.kernels.gpu.device import largest_budget
from splatmill_worker.splat.plan.budget import Budget
from splatmill_worker.splat.plan.deadline import training_seconds
from splatmill_worker.splat.plan.facts import Facts, Speed
from splatmill_worker.splat.plan.in_view import share_in_view
from splatmill_worker.splat.plan.needs import HALF_TURN
from splatmill_worker.splat.plan.photos import BYTES_PER_PIXEL, least_gain, statistics_memory
from splatmill_worker.splat.plan.plan import Kernels, Plan
from splatmill_worker.splat.plan.reasons import Decision, by_option, switch
from splatmill_worker.splat.plan.schedule import MOST_VISITS

PIXELS_PER_GAUSSIAN = 50
"""Pixels of all training photos for each Gaussian that they resolve (decisions: PIXELS_PER_GAUSSIAN)."""

ROUNDED = 10**8
"""Bytes to which the memory that the process has is rounded up."""

SELDOM = 0.7
"""`share_in_view` below which a plan says that Gaussians are added more seldom."""

ASSUMED_SPEED = Speed(per_pixel=3e-8, per_gaussian=1e-7)
"""Speed of a machine that was not probed."""


class Capacity(NamedTuple):
    """The size of a run.

    max_gaussians: the largest number of Gaussians.
    budget: its limits in steps and seconds.
    steps: the number of steps that the budget is expected to allow.
    longest: steps up to which the budget is doubled where it proves too short; None: it stays.
    ends_at: steps after which few photos from one side end the run; None where the budget does.
    """

    max_gaussians: Decision[int]
    budget: Decision[Budget]
    steps: Decision[int]
    longest: int | None = None
    ends_at: int | None = None


def decide_capacity(
    facts: Facts, options: TrainOptions, kernels: Kernels, *, initial: int, pixels: float
) -> Capacity:
    """The largest number of Gaussians that a run may train, and its budget.

    initial: number of Gaussians before the first step.
    pixels: number of pixels of a photo at the training size.
    """
    most = _max_gaussians(facts, options, kernels, pixels, initial)
    # Charged as midway, in the logarithm, between the first Gaussians and the most (decisions: forecast).
    midway = math.sqrt(max(1, min(initial, most.value)) * most.value)
    return _ended(
        Capacity(most, *_budget(facts, options, (facts.speed or ASSUMED_SPEED).step(pixels, midway))),
        facts,
        most_steps(facts, options),
    )


def most_steps(facts: Facts, options: TrainOptions) -> int | None:
    """Steps after which a training ends, whatever its budget: where the photos are too few to set one aside that shows
    over-fitting, and look at the scene from one side. None where they are not.
    """
    watched = facts.views >= PHOTOS_PER_VALIDATION or options.target_psnr is not None
    if watched or facts.alignment is None or facts.alignment <= HALF_TURN:
        return None
    return MOST_VISITS * facts.views


def _ended(capacity: Capacity, facts: Facts, most: int | None) -> Capacity:
    """`capacity` with a budget of `most` steps at most."""
    budget, steps = capacity.budget, capacity.steps
    if most is None or (budget.value.steps is not None and budget.value.steps <= most):
        return capacity
    if steps.value > most:
        because = (
            f"{steps.reason} With {facts.views} photos from one side, none is set aside to watch for over-fitting, so "
            f"training ends after {MOST_VISITS} steps on each, {most}."
        )
        steps = Decision(most, because)
    return capacity._replace(
        budget=budget._replace(value=replace(budget.value, steps=most)), steps=steps, ends_at=most
    )


def decide_densification(facts: Facts, options: TrainOptions, most: int, *, initial: int) -> Decision[bool]:
    """Whether Gaussians are added in training, of which there may be `most`."""
    if initial >= most:
        because = f"Training starts with {initial} Gaussians, as many as are allowed."
    else:
        because = f"Training starts with {initial} Gaussians, and {most} are allowed."
        if facts.coverage is not None and share_in_view(facts) < SELDOM:
            because += (
                f" A photo has {100 * facts.coverage.in_view:.2g} % of the points in view (median), so they are added "
                "more seldom: when each has been in view often enough."
            )
    return switch(options.densify, Decision(initial < most, because))


def resolved(pixels: float, views: int) -> int:
    """Gaussians that so many training photos of so many pixels resolve."""
    return round(pixels * views / PIXELS_PER_GAUSSIAN)


def _max_gaussians(
    facts: Facts, options: TrainOptions, kernels: Kernels, pixels: float, initial: int
) -> Decision[int]:
    """The largest number of Gaussians: training adds them only where the photos ask for more detail, so that a limit is
    all that a plan needs (decisions: PIXELS_PER_GAUSSIAN).
    """
    by_photos = resolved(pixels, facts.views)
    kept = statistics_memory(options.max_memory, BYTES_PER_PIXEL * pixels * (facts.views + facts.held_out))
    if kernels == "gpu":
        photo_bytes = round(3 * pixels * (facts.views + facts.held_out))
        by_memory = largest_budget(options.max_memory or facts.memory_available, round(pixels), photo_bytes)
    else:
        by_memory = _within(facts, options, kept)
    most = min(max(by_photos, initial), by_memory)
    if options.max_gaussians is not None and options.max_gaussians <= most:
        return by_option(options.max_gaussians)
    counts = options.max_memory is not None and kernels != "gpu" and facts.memory_used > 0
    beside = ""
    if counts:
        statistics = f" and {format_bytes(kept)} for statistics of the photos" if kept else ""
        beside = f" beside the {format_bytes(facts.memory_used)} of the process{statistics}"
    because = {
        by_photos: f"{facts.views} photos of {round(pixels)} pixels resolve {by_photos} Gaussians. Training makes as "
        "many of them as the detail of the scene asks for.",
        by_memory: f"Memory holds {by_memory} Gaussians{beside}.",
    }
    return Decision(
        most, because.get(most, f"Training starts with {initial} Gaussians, more than the photos resolve.")
    )


def _within(facts: Facts, options: TrainOptions, kept: int) -> int:
    """Gaussians that memory holds: in half of what is free, or in what `max_memory` leaves beside the process and the
    `kept` bytes of statistics of the photos, but in half of it at least. What is beside them is rounded, so that the
    same command has the same limit.
    """
    if options.max_memory is None:
        return Plan.gaussians_within(facts.memory_available // 2)
    beside = facts.memory_used + kept
    rounded = min(math.ceil(beside / ROUNDED) * ROUNDED, options.max_memory // 2)
    best = options.steps is None or options.target_psnr is not None
    return Plan.gaussians_within(options.max_memory, rounded, best=best)


def _budget(
    facts: Facts, options: TrainOptions, step: float
) -> tuple[Decision[Budget], Decision[int], int | None]:
    """The budget, the number of steps that it is expected to allow, at `step` seconds each, and the longest."""
    if options.timed:
        return *_time_budget(facts, options, step), None
    if options.steps is not None:
        because = f"The option steps asks for {options.steps} steps."
        return by_option(Budget(options.steps)), Decision(options.steps, because), None
    steps, gain = preset_steps(options.ending, facts.views), least_gain(facts, options)
    reason = f"No budget was given; for {facts.views} photos, the preset {options.ending.value} allows {steps} steps"
    takes = f"{steps} steps take about {format_duration(steps * step)} on this machine, at most"
    if not gain:
        return Decision(Budget(steps), f"{reason}."), Decision(steps, f"{takes}."), None
    longest = PRESET_LONGEST * steps
    reason += f", and doubles them, up to {longest}, while the last doubling gained {gain:g} dB."
    takes += f", and {longest} steps {format_duration(longest * step)}."
    return Decision(Budget(steps), reason), Decision(steps, takes), longest


def _time_budget(facts: Facts, options: TrainOptions, step: float) -> tuple[Decision[Budget], Decision[int]]:
    seconds, limit = training_seconds(facts, options, step)
    affordable = max(1, int(seconds / step))
    steps = affordable if options.steps is None else min(affordable, options.steps)
    because = (
        f"{limit[0].upper()}{limit[1:]} at {1e3 * step:.1f} ms a step allow about {affordable} steps"
        + ("." if steps == affordable else f", of which the option steps asks for {steps}.")
    )
    few = PRESET_VISITS[Preset.draft]
    if steps < few * facts.views:
        needed = format_duration(few * facts.views * step)
        because += (
            f" They show each of {facts.views} photos {steps / facts.views:.1f} times. Up to about {few} times, every "
            f"doubling makes the pictures clearly sharper; that would take {needed}."
        )
    return by_option(Budget(options.steps, seconds)), Decision(steps, because)
