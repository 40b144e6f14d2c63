"""Decisions on parts of the engine that many scenes do without: far shell, gap filling, pose refinement."""

from __future__ import annotations

import math
from typing import NamedTuple

from splatmill.schema import Switch, TrainOptions
from splatmill_worker.splat.plan.facts import Facts
from splatmill_worker.splat.plan.plan import Kernels
from splatmill_worker.splat.plan.reasons import Decision, switch

MUCH_SKY = 0.05
"""Share of the photos' area from which sky counts: a smaller one may be a window or a white wall."""

MANY_GAPS = 0.1
"""Share of the photos' area, sky excluded, from which gaps are filled; smaller ones are left to densification."""

FEW_VIEWS = 12
"""Training photos below which they count as few: gaps are not filled, a far shell wants sky or views to several sides,
the background is black, and Adam averages over a thousand steps (decisions: FEW_VIEWS), (decisions: second-moment)."""

HALF_TURN = 2 / math.pi
"""Alignment of photos that look level and evenly over half a turn (decisions: FEW_VIEWS)."""

MIN_POSE_ERROR = 1.0
"""Reprojection error, in pixels at the training size, from which cameras are corrected: the photos do not resolve
smaller errors."""


class Needs(NamedTuple):
    """Which of these parts the plan has.

    far_shell: Gaussians behind the scene, wherever photos look.
    gaps: Gaussians where photos show something that no point describes.
    pose_refinement: training cameras are corrected.
    added: number of Gaussians that the far shell and the gaps add before the first step.
    """

    far_shell: Decision[bool]
    gaps: Decision[bool]
    pose_refinement: Decision[bool]
    added: int


def needs_of(facts: Facts, options: TrainOptions, kernels: Kernels, *, scale: float = 1.0) -> Needs:
    """The parts that the facts call for or the options force.

    scale: size of the photos in training over their size as they were loaded.

    Raises ValueError, as a sentence, for an option that cannot be followed with this scene or these kernels.
    """
    _check_seeds(facts, options)
    far_shell = switch(options.far_shell, _far_shell(facts))
    gaps = switch(options.gaps, _gaps(facts))
    poses = switch(options.pose_refinement, _poses(facts, kernels, scale))
    if poses.value:
        _check_poses(facts, kernels)
        poses = poses._replace(
            reason=f"{poses.reason} Held-out cameras are not corrected: fitting them to their photos would flatter the "
            "score."
        )
    covered = facts.coverage
    added = (
        0 if covered is None else (far_shell.value * covered.shell_points + gaps.value * covered.gap_points)
    )
    return Needs(far_shell, gaps, poses, added)


def _check_seeds(facts: Facts, options: TrainOptions) -> None:
    """Raise ValueError where an option asks for Gaussians beside points that are not there."""
    for name, asked in (("far_shell", options.far_shell), ("gaps", options.gaps)):
        if asked is not Switch.on:
            continue
        if facts.start is not None:
            raise ValueError(
                f"{name}=on adds Gaussians to those made from points, but this training starts from a model. "
                f"Set {name} to auto."
            )
        if facts.transparent:
            raise ValueError(
                f"{name}=on is for opaque photos, and {facts.transparent} of these are transparent. "
                f"Set {name} to auto."
            )
        if facts.coverage is None:
            raise ValueError(
                f"{name}=on needs points of the reconstruction that the photos show, and this scene has too few. "
                f"Set {name} to auto."
            )


def _check_poses(facts: Facts, kernels: Kernels) -> None:
    """Raise ValueError where cameras cannot be corrected."""
    if kernels == "gpu":
        raise ValueError(
            "pose_refinement=on needs gradients with respect to the cameras, which the gpu kernels do not compute. "
            "Set pose_refinement to auto, or backend to cpu."
        )
    if facts.views < 2:
        raise ValueError(
            "pose_refinement=on needs at least two photos: a model of one photo fits any camera. "
            "Set pose_refinement to auto, or add photos."
        )


def _far_shell(facts: Facts) -> Decision[bool]:
    if facts.start is not None:
        return Decision(False, "The given model is kept as it is.")
    if facts.transparent:
        return Decision(
            False, f"{facts.transparent} photos are transparent, so nothing stands behind the scene."
        )
    if facts.coverage is None:
        return Decision(False, "There are too few points to tell how far the scene extends.")
    sky = f"{100 * facts.coverage.sky_share:.0f} % of the photos look like sky"
    to_one_side = facts.alignment is None or facts.alignment > HALF_TURN
    if facts.views < FEW_VIEWS and facts.coverage.sky_share < MUCH_SKY and to_one_side:
        return Decision(
            False,
            f"{sky}, and {facts.views} photos to one side are too few to tell whether anything else is as far away.",
        )
    return Decision(
        True,
        f"{facts.coverage.shell_points} Gaussians stand on a far shell behind the scene, for what shows through its "
        f"holes and for sky; {sky}.",
    )


def _gaps(facts: Facts) -> Decision[bool]:
    if facts.start is not None:
        return Decision(False, "The given model is kept as it is.")
    if facts.coverage is None:
        if facts.transparent:
            return Decision(
                False,
                f"{facts.transparent} photos are transparent, so a place without points may be empty.",
            )
        return Decision(False, "There are too few points to tell where points are missing.")
    covered = facts.coverage
    gap = (
        f"{100 * covered.gap_share:.0f} % of what the photos show has no point near it "
        f"(median of {covered.sightings:.0f} points per photo)"
    )
    if covered.gap_share < MANY_GAPS:
        return Decision(False, f"Only {gap}.")
    if facts.views < FEW_VIEWS:
        return Decision(False, f"{gap}, but {facts.views} photos are too few to correct guessed depths.")
    if facts.alignment is not None and facts.alignment <= HALF_TURN:
        return Decision(
            False,
            f"{gap}, but the photos look over more than half a turn, so that those of one side would look through "
            "what is guessed from the other.",
        )
    return Decision(
        True,
        f"{gap}: {covered.gap_points} Gaussians are added there, at the depth of the nearest points.",
    )


def _poses(facts: Facts, kernels: Kernels, scale: float) -> Decision[bool]:
    if facts.reprojection is None:
        return Decision(False, "Without reprojection errors of points, the cameras are taken to be exact.")
    error = scale * facts.reprojection
    if facts.views < 2:
        return Decision(False, "A model of one photo fits any camera.")
    reprojection = f"The median reprojection error is {error:.2f} pixels"
    if facts.faces:
        return Decision(
            False, f"{reprojection}, but the faces of a photo share a camera, and would be corrected apart."
        )
    if error < MIN_POSE_ERROR:
        return Decision(False, f"{reprojection}; cameras are corrected from {MIN_POSE_ERROR:g} pixel.")
    if kernels == "gpu":
        return Decision(
            False,
            f"{reprojection}, which calls for correcting the cameras, but the gpu kernels cannot do so.",
        )
    return Decision(True, f"{reprojection}, so the cameras of training photos are corrected.")
