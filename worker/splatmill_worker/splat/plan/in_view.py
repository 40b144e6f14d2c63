"""What follows from how much of the scene a photo has in view: what steps leave out, and the length of a course."""

from __future__ import annotations

from splatmill.schema import Switch, TrainOptions
from splatmill_worker.splat.plan.facts import Facts
from splatmill_worker.splat.plan.plan import Kernels
from splatmill_worker.splat.plan.reasons import Decision, switch

MOST_IN_VIEW = 0.5
"""Share of the points in a photo's view up to which steps leave out the rest: from there on, what this saves exceeds
the sorting of the Gaussians at each densification by far (decisions: cluster-culling)."""

MANY_GAUSSIANS = 100_000
"""Number of Gaussians that a scene may have from which steps leave some out (decisions: cluster-culling)."""

LEAST_IN_VIEW = 1e-3
"""Share of the scene that photos have in view at least: of a larger scene, half of the photos show next to nothing."""


def share_in_view(facts: Facts) -> float:
    """How often a step has a given Gaussian in view, over how often it does where photos have half of the scene in
    view: `in_view` over MOST_IN_VIEW, at most 1. The course of a run follows it (decisions: steps-in-view).
    """
    if facts.coverage is None:
        return 1.0
    return min(1.0, max(facts.coverage.in_view, LEAST_IN_VIEW) / MOST_IN_VIEW)


def decide_culling(facts: Facts, options: TrainOptions, kernels: Kernels, most: int) -> Decision[bool]:
    """Whether steps leave out clusters of Gaussians out of view, of a scene that may have `most`.

    Raises ValueError, as a sentence, where the option asks the kernels for what they do not do.
    """
    if options.cluster_culling is Switch.on and kernels != "cpu":
        raise ValueError(
            f"cluster_culling=on is for the cpu kernels, and this training uses the {kernels} kernels. "
            "Set cluster_culling to auto, or backend to cpu."
        )
    return switch(options.cluster_culling, _needed(facts, kernels, most))


def _needed(facts: Facts, kernels: Kernels, most: int) -> Decision[bool]:
    if kernels == "gpu":
        return Decision(
            False, f"The gpu kernels project all Gaussians, up to {most}, and move those in view alone."
        )
    if kernels == "reference":
        return Decision(False, f"The reference computes all Gaussians at every step, up to {most}.")
    if facts.transparent:
        return Decision(
            False, f"{facts.transparent} photos are transparent, so that all photos show one object."
        )
    if facts.coverage is None:
        return Decision(False, f"{facts.points} points are too few to tell what photos have in view.")
    share = f"A photo has {100 * facts.coverage.in_view:.0f} % of the points in its view (median)"
    if facts.coverage.in_view > MOST_IN_VIEW:
        return Decision(False, f"{share}; steps leave out the rest where it is half of them at least.")
    if most < MANY_GAUSSIANS:
        return Decision(False, f"{share}, but {most} Gaussians are too few for steps to leave some out.")
    return Decision(
        True, f"{share}, so steps leave out Gaussians that are not, in clusters of 256, and catch up later."
    )
