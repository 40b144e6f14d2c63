"""Decisions on the photos: their size, what lies behind them, exposures, anti-aliasing, validation."""

from __future__ import annotations

from typing import Literal

from splatmill.schema import (
    PHOTOS_PER_VALIDATION,
    PRESET_GAIN,
    Background,
    Preset,
    Switch,
    TrainOptions,
    format_bytes,
)
from splatmill_worker.kernels.cpu.loss import STATISTICS_PER_PIXEL
from splatmill_worker.splat.engine.cpu import MOST_KEPT
from splatmill_worker.splat.plan.facts import Facts
from splatmill_worker.splat.plan.needs import FEW_VIEWS
from splatmill_worker.splat.plan.plan import Kernels
from splatmill_worker.splat.plan.reasons import Decision, by_option, switch
from splatmill_worker.splat.plan.schedule import MANY_VISITS

PRESET_SIZE: dict[Kernels, dict[Preset, int]] = {
    "reference": {Preset.draft: 64, Preset.balanced: 64, Preset.quality: 128},
    "cpu": {Preset.draft: 480, Preset.balanced: 640, Preset.quality: 960},
    "gpu": {Preset.draft: 640, Preset.balanced: 1280, Preset.quality: 1920},
}
"""Longest side of the photos, pixels."""

BLURRED = 1.5
"""Grey levels of 255: photos whose RMS change by halving is smaller are halved; a phone photo's noise is larger."""

HALVED_FROM = 256
"""Pixels: photos whose longest side is shorter are not halved."""

LIGHT_DEPARTS = 0.033
"""Natural logarithm: where one photo in ten departs more from the light of the photos around it, departures are taken
out (decisions: LIGHT_DEPARTS)."""

LIGHT_UNSEEN = 0.125
"""Share of the variance of smooth light that the photos around may leave unpredicted: where they tell less, what
departs from them may be smooth, and held-out photos share it (decisions: LIGHT_UNSEEN)."""

CERTAIN = 3.0
"""Standard errors of an exposure that a departure exceeds at least, to be one."""

MOST_VALIDATION = 8
"""Photos that are set aside at most: they are measured whole at every point of the curve. From MANY_VISITS on they are
set aside under a budget as well (decisions: best-validated)."""

PHOTO_SHARE = 1 / 8
"""Share of the memory of a run that photos may take in it, and their statistics again (decisions: photos-on-disk)."""

BYTES_PER_PIXEL = 4
"""Of a photo: three colours, and a mask or alpha."""

STATISTICS_OVER_PHOTO = STATISTICS_PER_PIXEL / BYTES_PER_PIXEL * (1 + 1 / 4 + 1 / 16)
"""Size of the SSIM statistics of a photo and of its two reduced copies, over that of the photo."""

DISTANCES_DIFFER = 4.0
"""Ratio of the distances from which the same point is seen, above which Gaussians are anti-aliased."""


def loading_size(options: TrainOptions, kernels: Kernels) -> int:
    """Longest side, in pixels, at which photos are loaded before their facts are known."""
    return options.image_size or PRESET_SIZE[kernels][options.preset]


def fit_in_memory(photo_bytes: int, memory: int) -> bool:
    """Whether photos of so many bytes lie in memory, of which a run may use `memory` bytes, and not in files."""
    return photo_bytes <= PHOTO_SHARE * memory


def statistics_memory(max_memory: int | None, photo_bytes: float) -> int:
    """Bytes of SSIM statistics that training keeps at most, of photos of so many bytes in all.

    Under a limit of `max_memory` bytes for all, it keeps those of all photos or of none: each photo comes once in a
    round, so that those of a few are used seldom (decisions: photo-statistics).
    """
    if max_memory is None:
        return MOST_KEPT
    most = min(MOST_KEPT, int(PHOTO_SHARE * max_memory))
    return most if STATISTICS_OVER_PHOTO * photo_bytes <= most else 0


def decide_photos_on_disk(facts: Facts) -> Decision[bool]:
    """Whether photos lie in files. It was decided by `fit_in_memory` before they were loaded; this says why."""
    if facts.photo_bytes is None:
        return Decision(facts.photos_on_disk, "")
    photos = f"{facts.views + facts.held_out} photos take {format_bytes(facts.photo_bytes)}"
    if not facts.photos_on_disk:
        return Decision(False, f"{photos}, which memory holds.")
    return Decision(
        True,
        f"{photos}, more than an eighth of the memory. So they lie decoded in files, and steps read them ahead.",
    )


def decide_image_size(facts: Facts, options: TrainOptions) -> Decision[int]:
    """Longest side of the photos in training, in pixels: that of the loaded photos, or half of it."""
    longest = max(facts.width, facts.height)
    if options.image_size is not None:
        return by_option(longest)
    if longest < HALVED_FROM:
        return Decision(longest, f"Photos of {longest} pixels are too small to be halved.")
    if facts.halving_loss < BLURRED:
        half = (longest + 1) // 2
        return Decision(
            half,
            f"Halving the photos changes them by only {facts.halving_loss:.1f} of 255 grey levels, so they are "
            f"trained at {half} pixels.",
        )
    allowed = (
        f"the full size of {longest} pixels"
        if facts.native_longest <= longest
        else f"{longest} of {facts.native_longest} pixels, as the preset allows"
    )
    return Decision(
        longest,
        f"Halving the photos would lose {facts.halving_loss:.1f} of 255 grey levels, so they are trained at {allowed}.",
    )


def decide_background(facts: Facts, options: TrainOptions) -> Decision[Literal["black", "white", "random"]]:
    """The colour behind Gaussians and transparent photos (decisions: random-background)."""
    if options.background is not Background.auto:
        named: dict[Background, Literal["black", "white", "random"]] = {
            Background.black: "black",
            Background.white: "white",
            Background.random: "random",
        }
        return by_option(named[options.background])
    if facts.transparent:
        return Decision(
            "random",
            f"{facts.transparent} photos have transparent parts; over a random background, the model has to leave "
            "the same parts transparent.",
        )
    if facts.views < FEW_VIEWS:
        return Decision(
            "black",
            f"No photo is transparent. With only {facts.views} photos, a random background would make surfaces opaque "
            "at wrong depths.",
        )
    return Decision(
        "random",
        "No photo is transparent; a random background keeps training from hiding holes in the surface.",
    )


def decide_exposure(facts: Facts, options: TrainOptions) -> Decision[bool]:
    """Whether training photos are brought to the exposure and white balance that the photos around them predict.

    Raises ValueError where an option asks for it and the light of the photos cannot be compared.
    """
    if options.exposure is Switch.on and facts.light is None:
        raise ValueError(
            "exposure=on needs points that several photos show, since their colours tell how the light differs, and "
            "this scene has too few. Set exposure to auto."
        )
    return switch(options.exposure, _exposure(facts))


def differs_in_light(facts: Facts) -> bool:
    """Whether the photos differ so much in their light that their exposures are corrected where no option says
    otherwise."""
    return _exposure(facts).value


def _exposure(facts: Facts) -> Decision[bool]:
    if facts.light is None:
        return Decision(
            False,
            "The photos' exposures cannot be compared: it is not known which photos show the same points.",
        )
    tail, error = facts.light.tail, facts.light.error
    light = f"One photo in ten departs by {100 * tail:.1f} % or more from the light of the photos around it"
    if not tail >= LIGHT_DEPARTS:
        return Decision(False, f"{light}; exposures are corrected from {100 * LIGHT_DEPARTS:.1f} %.")
    if not tail >= CERTAIN * error:
        return Decision(
            False, f"{light}, which an error of {100 * error:.1f} % of their exposures may explain."
        )
    if facts.light.unseen > LIGHT_UNSEEN:
        return Decision(
            False,
            f"{light}, but the photos are too far apart to tell a change of exposure from light that changes with the "
            "direction of view.",
        )
    return Decision(True, f"{light}, so exposure and white balance of the training photos are corrected.")


def decide_antialias(facts: Facts, options: TrainOptions) -> Decision[bool]:
    """Whether opacities are compensated for the 0.3 pixels by which projection widens every Gaussian."""
    return switch(options.antialias, _antialias(facts))


def _antialias(facts: Facts) -> Decision[bool]:
    if facts.start is not None and facts.start.antialiased is not None:
        return Decision(facts.start.antialiased, "The file of the given model says how the model is drawn.")
    if facts.geometry is None:
        return Decision(False, "The distances from which points are seen are not known.")
    ratio = facts.geometry.distance_ratio
    if ratio > DISTANCES_DIFFER:
        return Decision(
            True,
            f"One point in ten is seen from distances that differ by a factor of {ratio:.1f} or more, so Gaussians are "
            "anti-aliased.",
        )
    return Decision(
        False,
        f"Nine points in ten are seen from distances that differ by a factor of {ratio:.1f} at most; anti-aliasing is "
        f"used above {DISTANCES_DIFFER:.0f}.",
    )


def least_gain(facts: Facts, options: TrainOptions) -> float | None:
    """Gain of a doubling of the steps on the validation photos, dB, below which training ends.

    That of the preset where no budget is given; 0 where training ends only once it over-fits; None where a target alone
    ends it before its budget, and where a model is given: it may have been trained on any of the photos, which would
    then show it best before the first step.
    """
    if facts.start is not None:
        return None
    if options.doubles(facts.views):
        return PRESET_GAIN[options.ending]
    return 0.0 if options.target_psnr is None else None


def decide_validation(facts: Facts, options: TrainOptions, steps: int) -> Decision[int | None]:
    """Number of training photos that are set aside for decisions made while training; None where none is needed.

    Held-out photos are for the report alone: a run that stopped by them would be judged by photos that it was chosen
    by. Raises ValueError where a target is asked for and no photo can be spared.

    steps: number of steps that the budget is expected to allow.
    """
    count, gain = min(MOST_VALIDATION, facts.views // PHOTOS_PER_VALIDATION), least_gain(facts, options)
    if options.target_psnr is not None:
        if facts.views < 2:
            raise ValueError(
                "target_psnr is measured on photos that are not trained on, and the only photo is needed for training. "
                "Leave out target_psnr, or add photos."
            )
        count = max(1, count)
        what = f"the training ends when their mean PSNR reaches {options.target_psnr:g} dB"
    elif facts.start is not None:
        return Decision(
            None,
            f"The given model may have been trained on any of the {facts.views} photos, so that none of them could "
            "judge by being set aside, and the training does not end before its budget.",
        )
    elif gain:
        what = (
            "the training ends when the last doubling of the steps has raised their mean PSNR by less than "
            f"{gain:g} dB"
        )
    elif count == 0:
        return Decision(
            None,
            f"{facts.views} photos are too few to set one aside, which is done from {PHOTOS_PER_VALIDATION} photos on, "
            "so the training does not end before its budget.",
        )
    else:
        visits = steps / facts.views
        shown = f"bout {steps} steps show each of {facts.views} photos {visits:.0f} times"
        if visits < MANY_VISITS:
            return Decision(
                None,
                f"A{shown}, and over-fitting is watched for from {MANY_VISITS} times on: the budget alone ends the "
                "training.",
            )
        what = f"a{shown}; where that no longer raises their mean PSNR, the training goes back to its best and ends"
    return Decision(
        count, f"{count} of {facts.views} training photos are set aside until the last decision: {what}."
    )


def undistortion(facts: Facts) -> Decision[bool]:
    """Whether loading the photos removed lens distortion."""
    if not facts.distorted:
        return Decision(False, "No photo has lens distortion.")
    by = "" if facts.lens_residual is None else f", by up to {facts.lens_residual:.1f} pixels"
    return Decision(True, f"The lens distorts {facts.distorted} photos{by}, so they are undistorted.")
