"""From facts and options to a plan: pure, so that the same facts and options always give the same plan."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, NamedTuple

from splatmill.schema import PRESET_GAIN, TrainOptions
from splatmill_worker.kernels.records import BETA2
from splatmill_worker.splat.plan.capacity import Capacity, decide_capacity, decide_densification
from splatmill_worker.splat.plan.facts import Facts
from splatmill_worker.splat.plan.needs import FEW_VIEWS, Needs, needs_of
from splatmill_worker.splat.plan.photos import (
    decide_antialias,
    decide_background,
    decide_exposure,
    decide_image_size,
    decide_validation,
    explain_undistortion,
)
from splatmill_worker.splat.plan.plan import Kernels, Plan
from splatmill_worker.splat.plan.rates import PAPER_STEPS, Annealing, beta2_of, boost_of
from splatmill_worker.splat.plan.reasons import Reasons
from splatmill_worker.splat.plan.schedule import MANY_VISITS, Schedule
from splatmill_worker.splat.start.frusta import RANDOM_GAUSSIANS
from splatmill_worker.splat.start.given_model import GivenModel
from splatmill_worker.splat.start.hull import at_first
from splatmill_worker.splat.start.points import ENOUGH_POINTS

OPACITY_DECAY = 0.9
"""Factor on opacities at each densification (decisions: OPACITY_DECAY)."""

DROPOUT = 0.2
"""Largest share of the Gaussians that a step leaves out: the value of Park et al. 2025 (decisions: dropout)."""


def decide(facts: Facts, options: TrainOptions, kernels: Kernels) -> Plan:
    """The plan for a scene. Each decision has a sentence with the fact or the option that it follows from.

    Raises ValueError, as a sentence, for an option that cannot be followed with this scene or these kernels.
    """
    reasons = Reasons()
    image_size = decide_image_size(facts, options, reasons)
    scale = min(1.0, image_size / max(facts.width, facts.height))
    source, gaussians = _start(facts, reasons)
    needs = needs_of(facts, options, kernels, reasons, scale=scale)
    initial = gaussians + (needs.added if source == "points" else 0)
    capacity = decide_capacity(
        facts, options, kernels, reasons, initial=initial, pixels=facts.pixels * scale**2
    )
    if facts.hull_points is not None and source == "hull":
        added = at_first(facts.hull_points, capacity.max_gaussians)
        reasons.chosen["initial"] += f" {added} more start at random within it."
        initial = min(initial + added, capacity.max_gaussians)
    densify = decide_densification(options, capacity, reasons, initial=initial)
    schedule = _schedule(facts, options, capacity, needs, densify, image_size, reasons)
    explain_undistortion(facts, reasons)
    validation = decide_validation(facts, options, reasons)
    return Plan(
        schedule=schedule,
        image_size=image_size,
        max_gaussians=capacity.max_gaussians,
        densify=densify,
        initial=source,
        kernels=kernels,
        background=decide_background(facts, options, reasons),
        exposure=decide_exposure(facts, options, reasons),
        antialias=decide_antialias(facts, options, reasons),
        target_psnr=options.target_psnr,
        max_memory=options.max_memory,
        stops_when_flat=validation is not None and options.steps is None and options.time_budget is None,
        seed=options.seed,
        far_shell=needs.far_shell,
        gaps=needs.gaps,
        pose_refinement=needs.pose_refinement,
        validation=validation,
        least_gain=PRESET_GAIN[options.ending],
        reasons=reasons.chosen,
        left_out=reasons.left_out,
        forced=tuple(reasons.forced),
    )


class _Start(NamedTuple):
    """What the first Gaussians are made from, and their number without those added in a hull."""

    source: Literal["points", "hull", "random", "model"]
    gaussians: int


def _start(facts: Facts, reasons: Reasons) -> _Start:
    if facts.start is not None:
        reasons.chosen["initial"] = (
            f"The given model has {facts.start.gaussians} Gaussians and shows the training photos at "
            f"{facts.start.psnr:.1f} dB."
        )
        reasons.forced.append("initial")
        return _Start("model", facts.start.gaussians)
    if facts.hull_points is not None:
        reasons.chosen["initial"] = (
            f"{facts.points} points of the reconstruction become Gaussians, and the outlines of {facts.transparent} "
            "transparent photos bound the object by their visual hull."
        )
        return _Start("hull", facts.points)
    unbounded = "" if facts.no_hull is None else f" {facts.no_hull}"
    if facts.points >= ENOUGH_POINTS:
        reasons.chosen["initial"] = (
            f"The reconstruction has {facts.points} points; each becomes a Gaussian.{unbounded}"
        )
        return _Start("points", facts.points)
    because = "" if facts.no_points is None else f"{facts.no_points} "
    reasons.chosen["initial"] = (
        f"{because}The scene has {facts.points} points, fewer than {ENOUGH_POINTS}, so "
        f"{RANDOM_GAUSSIANS} Gaussians start at random where the cameras look.{unbounded}"
    )
    return _Start("random", RANDOM_GAUSSIANS)


def _schedule(
    facts: Facts,
    options: TrainOptions,
    capacity: Capacity,
    needs: Needs,
    densify: bool,
    image_size: int,
    reasons: Reasons,
) -> Schedule:
    steps = capacity.steps
    shell = None if facts.coverage is None else facts.coverage.shell_distance
    schedule = Schedule(
        budget=capacity.budget,
        resolution=_resolution(steps, image_size, reasons),
        degree=_degree(facts, options, reasons),
        densify_from=max(50, min(300, steps // 8)),
        densify_every=max(40, min(100, steps // 20)),
        densify_until=0.7,
        opacity_decay=OPACITY_DECAY if densify else 1.0,
        # Half way to the shell, so that all of the shell is spared and most of the scene is not.
        decay_within=0.5 * shell if needs.far_shell and shell else None,
        annealing=_annealing(facts, options, steps, reasons),
        dropout=_dropout(facts, steps, reasons),
        expected_steps=steps,
    )
    return schedule if facts.start is None else _warm_start(schedule, facts.start, reasons)


def _resolution(steps: int, image_size: int, reasons: Reasons) -> tuple[tuple[int, int], ...]:
    """Coarse to fine: a quarter of the photos' size first, then half, then all of it (decisions: coarse-to-fine)."""
    first, second = max(20, min(200, steps // 8)), max(50, min(500, steps // 3))
    if image_size < 100:
        reasons.left_out["coarse_to_fine"] = f"Photos of {image_size} pixels are too small to be reduced."
        return ((0, 1),)
    if image_size < 240:
        return ((0, 2), (second, 1))
    return ((0, 4), (first, 2), (second, 1))


def _degree(facts: Facts, options: TrainOptions, reasons: Reasons) -> int:
    """Degree of the spherical harmonics: small angles between views do not determine high degrees."""
    if options.sh_degree is not None:
        reasons.option("sh_degree")
        return options.sh_degree
    angle = None if facts.geometry is None else facts.geometry.view_angle
    if angle is None:
        reasons.chosen["sh_degree"] = "The angles between the views of a point are not known."
        return 3
    reasons.chosen["sh_degree"] = (
        f"Half of the points are seen from directions that are {angle:.0f} degrees apart or more."
    )
    return 1 if angle < 6.0 else 2 if angle < 12.0 else 3


def _annealing(facts: Facts, options: TrainOptions, steps: int, reasons: Reasons) -> Annealing:
    boost = boost_of(steps)
    # A shorter average keeps steps large, and few photos lose by that (decisions: second-moment).
    beta2 = beta2_of(steps) if facts.views >= FEW_VIEWS else BETA2
    averaged = min(steps, round(1.0 / (1.0 - beta2)))
    because = (
        f"For {steps} steps, squared gradients are averaged over {averaged} of them, and learning "
        f"rates are {boost:.1f} times those of a run of {PAPER_STEPS} steps"
    )
    if options.time_budget is None:
        reasons.chosen["rates"] = f"{because}."
        return Annealing(boost=boost, beta2=beta2)
    reasons.chosen["rates"] = f"{because}; the factor follows the number of steps that the time allows."
    return Annealing(boost=None, beta2=beta2)


def _dropout(facts: Facts, steps: int, reasons: Reasons) -> float:
    """Largest share of the Gaussians that a step leaves out: else what few photos show is learnt by heart."""
    visits = steps / max(1, facts.views)
    reasons.chosen["dropout"] = (
        f"About {steps} steps show each of {facts.views} photos {visits:.0f} times; from {MANY_VISITS} times on, steps "
        f"leave out a random part of the Gaussians, up to {100 * DROPOUT:.0f} %."
    )
    return DROPOUT


def _warm_start(schedule: Schedule, model: GivenModel, reasons: Reasons) -> Schedule:
    """The schedule for a model that is trained already (decisions: warm-start): full-size photos, no boost.

    With boosted rates, the first steps would make the trained model worse.
    """
    reasons.left_out["coarse_to_fine"] = "The given model is trained already; reduced photos would blur it."
    reasons.chosen["rates"] = (
        f"The given model is trained already, so learning rates and the average of squared gradients are those of a "
        f"run of {PAPER_STEPS} steps."
    )
    degree = schedule.degree
    if "sh_degree" not in reasons.forced and model.degree > degree:
        degree = model.degree
        reasons.chosen["sh_degree"] = f"The given model has spherical harmonics of degree {degree}."
    return replace(schedule, resolution=((0, 1),), annealing=Annealing(boost=1.0), degree=degree)
