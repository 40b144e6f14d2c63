"""From facts and options to a plan: pure, so that the same facts and options always give the same plan."""

from __future__ import annotations

import math
from typing import Any, Literal

from splatmill.schema import PHOTOS_PER_VALIDATION, Background, TrainOptions
from splatmill_worker.kernels.records import BETA2
from splatmill_worker.splat.plan.capacity import decide_capacity, decide_densification
from splatmill_worker.splat.plan.course import densification, resolution
from splatmill_worker.splat.plan.facts import Facts
from splatmill_worker.splat.plan.in_view import decide_culling, share_in_view
from splatmill_worker.splat.plan.needs import FEW_VIEWS, needs_of
from splatmill_worker.splat.plan.photos import (
    decide_antialias,
    decide_background,
    decide_exposure,
    decide_image_size,
    decide_photos_on_disk,
    decide_validation,
    differs_in_light,
    least_gain,
    undistortion,
)
from splatmill_worker.splat.plan.plan import Kernels, Plan
from splatmill_worker.splat.plan.rates import PAPER_STEPS, Annealing, beta2_of, boost_of
from splatmill_worker.splat.plan.reasons import Decision, Explanation, by_option
from splatmill_worker.splat.plan.schedule import MANY_VISITS, Schedule
from splatmill_worker.splat.plan.scores import decide_lpips
from splatmill_worker.splat.start.frusta import RANDOM_GAUSSIANS
from splatmill_worker.splat.start.hull import at_first
from splatmill_worker.splat.start.points import ENOUGH_POINTS

OPACITY_DECAY = 0.9
"""Factor on opacities at each densification (decisions: OPACITY_DECAY)."""

GROWTH, UNEVEN_GROWTH = 0.7, 0.5
"""Shares of a run after which no Gaussians are added: where photos agree in their light, and where they do not
(decisions: growth-until)."""

DROPOUT = 0.2
"""Largest share of the Gaussians that a step leaves out: the value of Park et al. 2025 (decisions: dropout). Each is
drawn by itself, not with its neighbours (decisions: neighbour-dropout)."""


def decide(facts: Facts, options: TrainOptions, kernels: Kernels) -> Plan:
    """The plan for a scene. Each decision has a sentence with the fact or the option that it follows from.

    Raises ValueError, as a sentence, for an option that cannot be followed with this scene or these kernels.
    """
    image_size = decide_image_size(facts, options)
    scale = min(1.0, image_size.value / max(facts.width, facts.height))
    start, gaussians = _start(facts)
    needs = needs_of(facts, options, kernels, scale=scale)
    initial = gaussians + (needs.added if start.value == "points" else 0)
    capacity = decide_capacity(facts, options, kernels, initial=initial, pixels=facts.pixels * scale**2)
    most, steps = capacity.max_gaussians.value, capacity.steps.value
    if facts.hull_points is not None and start.value == "hull":
        added = at_first(facts.hull_points, most)
        start = start._replace(reason=f"{start.reason} {added} more start at random within it.")
        initial = min(initial + added, most)
    decisions: dict[str, Decision[Any]] = {
        "image_size": image_size,
        "photos_on_disk": decide_photos_on_disk(facts),
        "initial": start,
        "far_shell": needs.far_shell,
        "gaps": needs.gaps,
        "pose_refinement": needs.pose_refinement,
        "max_gaussians": capacity.max_gaussians,
        "cluster_culling": (culling := decide_culling(facts, options, kernels, most)),
        "budget": capacity.budget,
        "schedule": capacity.steps,
        "densify": (densify := decide_densification(facts, options, most, initial=initial)),
        "growth": (growth := _growth(facts)),
        "coarse_to_fine": (coarse := _coarse_to_fine(facts, image_size.value)),
        "sh_degree": (degree := _degree(facts, options)),
        "rates": (annealing := _annealing(facts, options, steps)),
        "dropout": (dropout := _dropout(facts, steps)),
        "undistortion": undistortion(facts),
        "masks": Decision(facts.masked > 0, "" if facts.masked else "No photo has masked pixels."),
        "validation": (validation := decide_validation(facts, options, steps)),
        "lpips": (lpips := decide_lpips(facts, options)),
        "background": (background := decide_background(facts, options)),
        "alpha": _alpha(facts, options),
        "exposure": (exposure := decide_exposure(facts, options)),
        "antialias": (antialias := decide_antialias(facts, options)),
    }
    explanation, gain = Explanation.of(decisions), least_gain(facts, options)
    share = share_in_view(facts)
    densify_from, densify_every = densification(steps, share)
    shell = None if facts.coverage is None else facts.coverage.shell_distance
    return Plan(
        schedule=Schedule(
            budget=capacity.budget.value,
            longest=capacity.longest,
            resolution=resolution(steps, share, image_size.value) if coarse.value else ((0, 1),),
            degree=degree.value,
            densify_from=densify_from,
            densify_every=densify_every,
            densify_until=growth.value,
            opacity_decay=OPACITY_DECAY if densify.value else 1.0,
            # Half way to the shell, so that all of the shell is spared and most of the scene is not.
            decay_within=0.5 * shell if needs.far_shell.value and shell else None,
            annealing=annealing.value,
            dropout=dropout.value,
            ends_at=capacity.ends_at,
            expected_steps=steps,
            in_view=share,
            # What a photo has in view is a part of a surface (decisions: steps-in-view).
            position_scale=math.sqrt(share),
        ),
        image_size=image_size.value,
        max_gaussians=most,
        densify=densify.value,
        initial=start.value,
        kernels=kernels,
        background=background.value,
        exposure=exposure.value,
        antialias=antialias.value,
        target_psnr=options.target_psnr,
        max_memory=options.max_memory,
        stops_when_flat=validation.value is not None and gain is not None,
        seed=options.seed,
        far_shell=needs.far_shell.value,
        gaps=needs.gaps.value,
        pose_refinement=needs.pose_refinement.value,
        cluster_culling=culling.value,
        validation=validation.value,
        least_gain=gain or 0.0,
        lpips=lpips.value,
        reasons=explanation.chosen,
        left_out=explanation.left_out,
        forced=explanation.forced,
    )


def _start(facts: Facts) -> tuple[Decision[Literal["points", "hull", "random", "model"]], int]:
    """What the first Gaussians are made from, and their number without those added in a hull."""
    if facts.start is not None:
        return (
            Decision(
                "model",
                f"The given model has {facts.start.gaussians} Gaussians and shows the training photos at "
                f"{facts.start.psnr:.1f} dB.",
                forced=True,
            ),
            facts.start.gaussians,
        )
    if facts.hull_points is not None:
        return (
            Decision(
                "hull",
                f"{facts.points} points of the reconstruction become Gaussians, and the outlines of "
                f"{facts.transparent} transparent photos bound the object by their visual hull.",
            ),
            facts.points,
        )
    unbounded = "" if facts.no_hull is None else f" {facts.no_hull}"
    if facts.points >= ENOUGH_POINTS:
        because = f"The reconstruction has {facts.points} points; each becomes a Gaussian.{unbounded}"
        return Decision("points", because), facts.points
    because = "" if facts.no_points is None else f"{facts.no_points} "
    return (
        Decision(
            "random",
            f"{because}The scene has {facts.points} points, fewer than {ENOUGH_POINTS}, so "
            f"{RANDOM_GAUSSIANS} Gaussians start at random where the cameras look.{unbounded}",
        ),
        RANDOM_GAUSSIANS,
    )


def _alpha(facts: Facts, options: TrainOptions) -> Decision[bool]:
    """Whether photos are transparent; without a reason where an option fixes the background."""
    said = not facts.transparent and options.background is Background.auto
    return Decision(facts.transparent > 0, "No photo is transparent." if said else "")


def _growth(facts: Facts) -> Decision[float]:
    """Share of the run after which no Gaussians are added."""
    if differs_in_light(facts):
        return Decision(
            UNEVEN_GROWTH,
            f"The photos differ in their light, which late Gaussians would learn: none are added after "
            f"{100 * UNEVEN_GROWTH:.0f} % of the run.",
        )
    return Decision(GROWTH, "")


def _coarse_to_fine(facts: Facts, image_size: int) -> Decision[bool]:
    """Whether training begins with reduced photos."""
    if facts.start is not None:
        return Decision(False, "The given model is trained already; reduced photos would blur it.")
    if image_size < 100:
        return Decision(False, f"Photos of {image_size} pixels are too small to be reduced.")
    return Decision(True, "")


def _degree(facts: Facts, options: TrainOptions) -> Decision[int]:
    """Degree of the spherical harmonics: small angles between views do not determine high degrees; that of a given
    model is kept.
    """
    if options.sh_degree is not None:
        return by_option(options.sh_degree)
    angle = None if facts.geometry is None else facts.geometry.view_angle
    degree = 3 if angle is None or angle >= 12.0 else 1 if angle < 6.0 else 2
    if facts.start is not None and facts.start.degree > degree:
        degree = facts.start.degree
        return Decision(degree, f"The given model has spherical harmonics of degree {degree}.")
    if angle is None:
        return Decision(degree, "The angles between the views of a point are not known.")
    return Decision(
        degree, f"Half of the points are seen from directions that are {angle:.0f} degrees apart or more."
    )


def _annealing(facts: Facts, options: TrainOptions, steps: int) -> Decision[Annealing]:
    """Learning rates; a given model keeps those of a long run (decisions: warm-start): with boosted rates, the first
    steps would make it worse.
    """
    if facts.start is not None:
        return Decision(
            Annealing(boost=1.0),
            f"The given model is trained already, so learning rates and the average of squared gradients are those of "
            f"a run of {PAPER_STEPS} steps.",
        )
    boost = boost_of(steps)
    # A shorter average keeps steps large, and few photos lose by that (decisions: second-moment).
    beta2 = beta2_of(steps) if facts.views >= FEW_VIEWS else BETA2
    averaged = min(steps, round(1.0 / (1.0 - beta2)))
    because = (
        f"For {steps} steps, squared gradients are averaged over {averaged} of them, and learning "
        f"rates are {boost:.1f} times those of a run of {PAPER_STEPS} steps"
    )
    if options.timed:
        because += "; the factor follows the number of steps that the time allows"
    hold = _hold(facts, steps)
    if hold < Annealing.hold:
        because += (
            f". With {facts.views} photos, none is set aside to watch for over-fitting, so the rates fall from the "
            f"{MANY_VISITS}th step on each"
        )
    return Decision(Annealing(boost=None if options.timed else boost, hold=hold, beta2=beta2), f"{because}.")


def _hold(facts: Facts, steps: int) -> float:
    """Share of the budget at full learning rates: where no photo can be set aside, MANY_VISITS steps on each photo at
    most, since what later steps learn is rather the photos than the scene (decisions: few-photos-rates).
    """
    if facts.views >= PHOTOS_PER_VALIDATION:
        return Annealing.hold
    return min(Annealing.hold, MANY_VISITS * facts.views / steps)


def _dropout(facts: Facts, steps: int) -> Decision[float]:
    """Largest share of the Gaussians that a step leaves out; it reduces over-fitting to few photos."""
    visits = steps / max(1, facts.views)
    return Decision(
        DROPOUT,
        f"About {steps} steps show each of {facts.views} photos {visits:.0f} times; from {MANY_VISITS} times on, steps "
        f"leave out a random part of the Gaussians, up to {100 * DROPOUT:.0f} %.",
    )
