"""What a scene needs beside Gaussians on its points: what stands behind all, gaps filled, better cameras."""

from __future__ import annotations

from typing import NamedTuple

from splatmill.schema import Switch, TrainOptions
from splatmill_worker.splat.plan.facts import Facts
from splatmill_worker.splat.plan.plan import Kernels
from splatmill_worker.splat.plan.reasons import Reasons

MUCH_SKY = 0.05
"""Of all photos; less is a window or a white wall."""

MANY_GAPS = 0.1

FEW_VIEWS = 12
"""With fewer photos, hardly any other corrects what was guessed: kermit (9 to train on) ends 1.3 dB lower with its gaps
filled, and 1.2 with a far shell."""

POSES_OFF = 1.0
"""Pixels at the training size: below, cameras err by less than the photos resolve."""


class Needs(NamedTuple):
    """Fields of the plan, and the Gaussians that they add before the first step."""

    far_shell: bool
    gaps: bool
    pose_refinement: bool
    added: int


def needs_of(
    facts: Facts, options: TrainOptions, kernels: Kernels, why: Reasons, *, error_scale: float = 1.0
) -> Needs:
    """The needs that the facts show or the options force, each with its sentence in `why`.

    error_scale: pixels at the training size for one of the photos as they were loaded.

    Raises ValueError, as a sentence, for an option that this scene cannot follow.
    """
    added = (("far_shell", options.far_shell), ("gaps", options.gaps))
    for name, asked in added:
        if asked is Switch.on and facts.start is not None:
            raise ValueError(
                f"{name}=on adds to points; this training starts from a model. Leave it at auto."
            )
    shell = why.switch("far_shell", options.far_shell, *_far_shell(facts))
    gaps = why.switch("gaps", options.gaps, *_gaps(facts))
    poses = why.switch("pose_refinement", options.pose_refinement, *_poses(facts, kernels, error_scale))
    if poses:
        why.chosen["pose_refinement"] += (
            " Held-out cameras stay as they came, so that their score is not flattered."
        )
    for name, asked in added:
        if asked is Switch.on and facts.transparent:
            raise ValueError(
                f"{name}=on is for opaque photos, and {facts.transparent} of these are transparent. Leave it at auto."
            )
        if asked is Switch.on and facts.sightings is None:
            raise ValueError(
                f"{name}=on needs points that the photos show, and there are none. Leave it at auto."
            )
    if poses and kernels == "gpu":
        raise ValueError(
            "pose_refinement=on needs the gradient to cameras, which the gpu kernels do not give. Use backend=cpu."
        )
    if poses and facts.views < 2:
        raise ValueError(
            "pose_refinement=on needs at least two photos: one alone shows any error of its camera."
        )
    return Needs(shell, gaps, poses, shell * facts.shell_points + gaps * facts.gap_points)


def _far_shell(facts: Facts) -> tuple[bool, str]:
    if facts.start is not None:
        return False, "The model given stands for it."
    if facts.transparent:
        return False, f"{facts.transparent} photos are transparent: nothing stands behind the scene."
    if facts.sky_share is None:
        return False, "How far away the scene ends cannot be told without points in the photos."
    seen = f"{100 * facts.sky_share:.0f} % of the photos look like sky"
    if facts.views < FEW_VIEWS and facts.sky_share < MUCH_SKY:
        return False, f"{seen}, and {facts.views} photos are too few to tell what else is that far."
    return True, f"{seen}: {facts.shell_points} Gaussians stand for it, and behind whatever has holes."


def _gaps(facts: Facts) -> tuple[bool, str]:
    if facts.start is not None:
        return False, "The model given stands for it."
    if facts.gap_share is None:
        return False, "Where points are missing cannot be told without points in the photos."
    seen = f"{100 * facts.gap_share:.0f} % of what the photos show has no point near it"
    if facts.sightings is not None:
        seen += f" ({facts.sightings:.0f} points a photo)"
    if facts.gap_share < MANY_GAPS:
        return False, f"Only {seen}."
    if facts.views < FEW_VIEWS:
        return False, f"{seen}, but {facts.views} photos are too few to correct depths that are guessed."
    return True, f"{seen}: {facts.gap_points} Gaussians are put there, as deep as the nearest points."


def _poses(facts: Facts, kernels: Kernels, error_scale: float) -> tuple[bool, str]:
    if facts.reprojection is None:
        return False, "The cameras are taken as given: there are no points to test them on."
    error = error_scale * facts.reprojection
    if facts.views < 2:
        return False, "One photo alone shows any error of its camera."
    seen = f"The cameras fit their points to {error:.2f} pixels"
    if error < POSES_OFF:
        return False, f"{seen}."
    if kernels == "gpu":
        return (
            False,
            f"{seen}, which would call for correcting them; the gpu kernels give no gradient to cameras.",
        )
    return True, f"{seen}: those of training photos are corrected."
