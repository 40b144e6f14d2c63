"""From facts and options to a plan: pure, so that the same facts always give the same plan."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal, NamedTuple

from splatmill.schema import Background, Preset, Switch, TrainOptions
from splatmill_worker.kernels.gpu.device import largest_budget
from splatmill_worker.splat.plan.budget import Budget
from splatmill_worker.splat.plan.facts import Facts, Speed
from splatmill_worker.splat.plan.needs import FEW_VIEWS, needs_of
from splatmill_worker.splat.plan.plan import Kernels, Plan
from splatmill_worker.splat.plan.rates import PAPER_STEPS, Annealing, boost_of
from splatmill_worker.splat.plan.reasons import Reasons
from splatmill_worker.splat.plan.schedule import Schedule
from splatmill_worker.splat.start.frusta import RANDOM_GAUSSIANS
from splatmill_worker.splat.start.given_model import GivenModel
from splatmill_worker.splat.start.points import ENOUGH_POINTS

PRESET_STEPS = {Preset.draft: 1000, Preset.balanced: 3000, Preset.quality: 10_000}
PRESET_SIZE: dict[Kernels, dict[Preset, int]] = {
    "reference": {Preset.draft: 64, Preset.balanced: 64, Preset.quality: 128},
    "cpu": {Preset.draft: 480, Preset.balanced: 640, Preset.quality: 960},
    "gpu": {Preset.draft: 640, Preset.balanced: 1280, Preset.quality: 1920},
}
GAUSSIANS_PER_ROOT_STEP = 1550.0
"""Gaussians per root of a step. More cost their time without showing more: on fox and lego, 600 steps gain 0.5 and
1.2 dB from 48,000 in place of 24,000, and 1500 steps nothing from 100,000 in place of 60,000."""

OPACITY_DECAY = 0.9
"""600 steps on fox, lund and lego gain 0.1 dB (0.03 to 0.4 over scenes and seeds); 0.97 gains about as much."""

PIXELS_PER_GAUSSIAN = 50
"""Over all training photos; more Gaussians cost their time and show no more. On fox, 300 s with 160,000 of them (35
pixels for each) ended as 300 s with 111,000: at 32.4 and 32.3 dB, over black."""

UNKNOWN_SPEED = Speed(per_pixel=3e-8, per_gaussian=1e-7)
BLURRED = 1.5  # grey levels of 255; below the noise of a phone's photo
EXPOSURES_DIFFER = 0.2
"""Log brightness. At 10 % (a phone's photos of one table) fitting exposures cost 1.6 dB: they follow other errors."""

TINTS_DIFFER = 0.1
DISTANCES_DIFFER = 4.0


def loading_size(options: TrainOptions, kernels: Kernels) -> int:
    """Longest side, in pixels, at which photos are loaded before their facts are known."""
    return options.image_size or PRESET_SIZE[kernels][options.preset]


def decide(facts: Facts, options: TrainOptions, kernels: Kernels) -> Plan:
    """The plan for a scene. Every field carries the fact or the option that decided it.

    Raises ValueError, as a sentence, for an option that this engine cannot follow.
    """
    why = Reasons()
    image_size = _image_size(facts, options, why)
    shrunk = (image_size / max(facts.width, facts.height)) ** 2
    pixels = facts.pixels * min(1.0, shrunk)
    initial, start = _initial(facts, why)
    needs = needs_of(facts, options, kernels, why, error_scale=math.sqrt(min(1.0, shrunk)))
    if initial == "points":
        start += needs.added
    speed = facts.speed or UNKNOWN_SPEED
    limits = _limits(facts, options, kernels, pixels, start)
    budget, steps = _budget(options, speed, pixels, start, limits, why)
    most = _max_gaussians(facts, options, limits, steps, pixels, start, why)
    densify = _densify(options, most, start, why)
    schedule = Schedule(
        budget=budget,
        resolution=_resolution(steps, image_size, why),
        degree=_degree(facts, options, why),
        densify_from=max(50, min(300, steps // 8)),
        densify_every=max(40, min(100, steps // 20)),
        densify_until=0.7,
        opacity_decay=OPACITY_DECAY if densify else 1.0,
        decay_within=0.5 * facts.shell_distance if needs.far_shell and facts.shell_distance else None,
        annealing=_annealing(options, steps, why),
        expected_steps=steps,
    )
    if facts.start is not None:
        schedule = _continued(schedule, facts.start, why)
    _undistortion(facts, why)
    return Plan(
        schedule=schedule,
        image_size=image_size,
        max_gaussians=most,
        densify=densify,
        initial=initial,
        kernels=kernels,
        background=_background(facts, options, why),
        exposure=_exposure(facts, options, why),
        antialias=_antialias(facts, options, why),
        target_psnr=options.target_psnr,
        max_memory=options.max_memory,
        stops_when_flat=options.steps is None and options.time_budget is None,
        seed=options.seed,
        far_shell=needs.far_shell,
        gaps=needs.gaps,
        pose_refinement=needs.pose_refinement,
        reasons=why.chosen,
        left_out=why.left_out,
        forced=tuple(why.forced),
    )


def _image_size(facts: Facts, options: TrainOptions, why: Reasons) -> int:
    longest = max(facts.width, facts.height)
    if options.image_size is not None:
        why.option("image_size")
        return longest
    if facts.halving_loss < BLURRED and longest >= 256:
        why.chosen["image_size"] = (
            f"Halving the photos changes them by {facts.halving_loss:.1f} of 255 grey levels: they hold no more."
        )
        return (longest + 1) // 2
    why.chosen["image_size"] = (
        f"Halving the photos would lose {facts.halving_loss:.1f} of 255 grey levels; "
        f"{longest} pixels is what the preset allows of {facts.native_longest}."
    )
    return longest


def _initial(facts: Facts, why: Reasons) -> tuple[Literal["points", "random", "model"], int]:
    if facts.start is not None:
        why.chosen["initial"] = (
            f"The {facts.start.gaussians} Gaussians of the model given show the photos at {facts.start.psnr:.1f} dB."
        )
        why.forced.append("initial")
        return "model", facts.start.gaussians
    if facts.points >= ENOUGH_POINTS:
        why.chosen["initial"] = f"The reconstruction has {facts.points} points."
        return "points", facts.points
    why.chosen["initial"] = (
        f"There are {facts.points} points to start from, so Gaussians start where cameras look."
    )
    return "random", RANDOM_GAUSSIANS


class _Limits(NamedTuple):
    """The most Gaussians that the photos resolve, that memory holds, and that any plan may have."""

    resolved: int
    held: int
    most: int


def _limits(facts: Facts, options: TrainOptions, kernels: Kernels, pixels: float, start: int) -> _Limits:
    resolved = round(pixels * facts.views / PIXELS_PER_GAUSSIAN)
    if kernels == "gpu":
        photos = round(3 * pixels * (facts.views + facts.held_out))
        held = largest_budget(options.max_memory or facts.memory_available, round(pixels), photos)
    else:
        held = Plan.gaussians_within(options.max_memory or facts.memory_available // 2)
    most = max(min(resolved, held), min(start, held))
    asked = options.max_gaussians
    return _Limits(resolved, held, most if asked is None else min(asked, most))


def _budget(
    options: TrainOptions, speed: Speed, pixels: float, start: int, limits: _Limits, why: Reasons
) -> tuple[Budget, int]:
    """The budget, and the number of steps it is expected to allow."""
    if options.time_budget is not None:
        steps = _affordable_steps(options.time_budget, speed, pixels, start, limits.most)
        if options.steps is not None:
            steps = min(steps, options.steps)
        why.option("budget")
        why.chosen["schedule"] = (
            f"{options.time_budget:g} s at {1e9 * speed.per_pixel:.0f} ns a pixel and "
            f"{1e9 * speed.per_gaussian:.0f} ns a Gaussian allow about {steps} steps."
        )
        return Budget(options.steps, options.time_budget), steps
    if options.steps is not None:
        why.option("budget")
        why.chosen["schedule"] = f"{options.steps} steps were asked for."
        return Budget(options.steps), options.steps
    preset = Preset.quality if options.target_psnr is not None else options.preset
    steps = PRESET_STEPS[preset]
    why.chosen["budget"] = f"No budget was given; the preset {preset.value} allows {steps} steps."
    why.chosen["schedule"] = why.chosen["budget"]
    return Budget(steps), steps


def _trainable(steps: int) -> int:
    """How many Gaussians `steps` steps are worth."""
    return round(GAUSSIANS_PER_ROOT_STEP * math.sqrt(steps))


def _affordable_steps(seconds: float, speed: Speed, pixels: float, start: int, most: int) -> int:
    """Steps in `seconds` when the number of Gaussians grows with the steps from `start`, up to `most`.

    A run is cheaper than its end: coarse photos and few Gaussians make the mean step about 0.8 of the last.
    """

    def fits(steps: int) -> bool:
        gaussians = min(most, max(start, _trainable(steps)))
        return 0.8 * steps * speed.step(pixels, gaussians) <= seconds

    few, many = 10, 10**7
    while few + 1 < many:
        middle = (few + many) // 2
        few, many = (middle, many) if fits(middle) else (few, middle)
    return few


def _max_gaussians(
    facts: Facts,
    options: TrainOptions,
    limits: _Limits,
    steps: int,
    pixels: float,
    start: int,
    why: Reasons,
) -> int:
    resolved, held, _ = limits
    settled = _trainable(steps)
    most = max(min(settled, resolved, held), min(start, held))
    if options.max_gaussians is not None:
        most = min(options.max_gaussians, max(most, min(resolved, held)))
        if most == options.max_gaussians:
            why.option("max_gaussians")
            return most
    reasons = {
        settled: f"About {steps} steps settle no more than {settled} Gaussians.",
        resolved: f"{facts.views} photos of {round(pixels)} pixels resolve no more than {resolved} Gaussians.",
        held: f"Memory holds no more than {held} Gaussians.",
    }
    why.chosen["max_gaussians"] = reasons.get(most, f"The scene starts with {start} Gaussians.")
    return most


def _densify(options: TrainOptions, most: int, start: int, why: Reasons) -> bool:
    if start >= most:
        reason = f"The {start} Gaussians to start with are all that the budget allows."
    else:
        reason = f"{start} Gaussians to start with do not resolve the photos; {most} may."
    return why.switch("densify", options.densify, start < most, reason)


def _resolution(steps: int, image_size: int, why: Reasons) -> tuple[tuple[int, int], ...]:
    """Pays in 10 s on fox and the still life, costs on lego. That starts at random, which is not why: fox without its
    points loses 0.7 to 0.9 dB at the same time when photos are never reduced (a trial of three seeds).
    """
    first, second = max(20, min(200, steps // 8)), max(50, min(500, steps // 3))
    if image_size < 100:
        why.left_out["coarse_to_fine"] = f"Photos of {image_size} pixels are coarse already."
        return ((0, 1),)
    if image_size < 240:
        return ((0, 2), (second, 1))
    return ((0, 4), (first, 2), (second, 1))


def _continued(schedule: Schedule, start: GivenModel, why: Reasons) -> Schedule:
    """The course of a scene that was trained before: what its beginning is for is done.

    The rates start as ever. On the fox, 300 steps on a model of 700 ended at 29.7 dB so, and at 29.5, 29.3 and 28.8 dB
    with a quarter, a half and three quarters of their fall skipped.
    """
    why.left_out["coarse_to_fine"] = "The model given is trained already; small photos would blur it."
    why.chosen["rates"] = (
        f"The model given is trained already: steps are no longer than in a run of {PAPER_STEPS}."
    )
    degree = schedule.degree
    if "sh_degree" not in why.forced and start.degree > degree:
        degree = start.degree
        why.chosen["sh_degree"] = f"The model given has spherical harmonics of degree {degree}."
    return replace(
        schedule,
        resolution=((0, 1),),
        # Longer steps would first undo what the model has learnt.
        annealing=replace(schedule.annealing, boost=1.0),
        degree=degree,
    )


def _annealing(options: TrainOptions, steps: int, why: Reasons) -> Annealing:
    boost = boost_of(steps)
    taken = f"{steps} steps are taken {boost:.1f} times as long as those of a run of {PAPER_STEPS}"
    if options.time_budget is None:
        why.chosen["rates"] = f"{taken}."
        return Annealing(boost=boost)
    why.chosen["rates"] = f"{taken}; should the time hold more or fewer, their length follows."
    return Annealing(boost=None)


def _degree(facts: Facts, options: TrainOptions, why: Reasons) -> int:
    if options.sh_degree is not None:
        why.option("sh_degree")
        return options.sh_degree
    angle = facts.view_angle
    if angle is None:
        why.chosen["sh_degree"] = "How far apart the views of a point are is not known."
        return 3
    degree = 1 if angle < 6.0 else 2 if angle < 12.0 else 3
    why.chosen["sh_degree"] = f"Half of the points are seen from directions up to {angle:.0f} degrees apart."
    return degree


def _background(facts: Facts, options: TrainOptions, why: Reasons) -> Literal["black", "white", "random"]:
    """Over black, dark surfaces stay transparent: on the fox, 1.8 % of the held-out pixels by more than a tenth.

    The ablation has black 0.35 dB worse on lund and not clearly different on fox and the still life (600 steps, three
    seeds). In trials, random colours gained 0.3 dB in 8000 steps on fox (one seed), and lost 0.6 and 0.9 dB in 800 on
    kermit, with 9 photos to train on (two seeds): FEW_VIEWS keeps black there.
    """
    if options.background is not Background.auto:
        why.option("background")
        named: dict[Background, Literal["black", "white", "random"]] = {
            Background.black: "black",
            Background.white: "white",
            Background.random: "random",
        }
        return named[options.background]
    if facts.transparent:
        why.chosen["background"] = (
            f"{facts.transparent} photos are transparent, and must stay so over any colour."
        )
        return "random"
    why.left_out["alpha"] = "No photo is transparent."
    if facts.views < FEW_VIEWS:
        why.chosen["background"] = (
            f"No photo is transparent, and {facts.views} are too few to say how deep an opaque surface has to be."
        )
        return "black"
    why.chosen["background"] = (
        "No photo is transparent: over colours that change, no hole passes for a surface."
    )
    return "random"


def _exposure(facts: Facts, options: TrainOptions, why: Reasons) -> bool:
    if options.exposure is not Switch.auto:
        why.forced.append("exposure")
        place = why.chosen if options.exposure is Switch.on else why.left_out
        place["exposure"] = "Set by option."
        return options.exposure is Switch.on
    spread = facts.exposure_spread
    if spread is None:
        why.left_out["exposure"] = (
            "Whether the photos' exposures differ cannot be measured: there are no tracks."
        )
        return False
    if spread > EXPOSURES_DIFFER:
        why.chosen["exposure"] = (
            f"The same points differ by {100 * spread:.0f} % in brightness between photos."
        )
        return True
    tint = facts.tint_spread
    if tint is not None and tint > TINTS_DIFFER:
        why.chosen["exposure"] = (
            f"White balances differ: the same points by {100 * tint:.0f} % between photos."
        )
        return True
    why.left_out["exposure"] = (
        f"Exposures agree: the same points differ by {100 * spread:.1f} % between photos."
    )
    return False


def _antialias(facts: Facts, options: TrainOptions, why: Reasons) -> bool:
    if options.antialias is not Switch.auto:
        why.forced.append("antialias")
        place = why.chosen if options.antialias is Switch.on else why.left_out
        place["antialias"] = "Set by option."
        return options.antialias is Switch.on
    ratio = facts.distance_ratio
    if ratio is not None and ratio > DISTANCES_DIFFER:
        why.chosen["antialias"] = f"Points are seen from distances that differ by a factor of {ratio:.1f}."
        return True
    seen = (
        "are not known"
        if ratio is None
        else f"differ by a factor of {ratio:.1f} at most for nine points in ten"
    )
    why.left_out["antialias"] = f"The distances that points are seen from {seen}."
    return False


def _undistortion(facts: Facts, why: Reasons) -> None:
    if facts.distorted:
        far = "" if facts.lens_residual is None else f" that moves pixels by up to {facts.lens_residual:.1f}"
        why.chosen["undistortion"] = f"{facts.distorted} photos were taken through a lens{far}."
    else:
        why.left_out["undistortion"] = "All cameras are pinholes already."
    if not facts.masked:
        why.left_out["masks"] = "No photo has pixels that are masked."
