"""What is trained when: resolution, degree of the spherical harmonics, densification, learning rates."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from splatmill_worker.splat.plan.budget import Budget
from splatmill_worker.splat.plan.course import densification
from splatmill_worker.splat.plan.rates import Annealing

MANY_VISITS = 100
"""Steps on each photo after which training begins to over-fit (decisions: dropout)."""

MOST_VISITS = 400
"""Steps on each photo after which a training ends that has too few photos to set one aside, all from one side
(decisions: MOST_VISITS)."""

SETTLING = 0.5
"""Share of the steps between two densifications in which training restores the opacities that the first one decayed
(decisions: SETTLING)."""


@dataclass(frozen=True)
class Schedule:
    """The course of a run.

    budget: its limits in steps and seconds.
    longest: steps up to which the budget is doubled where it proves too short; None: it stays.
    resolution: pairs of a step and the factor by which photos are reduced after it, until the next pair. Early steps
        gain as much from a small photo as from a large one.
    degree: of the spherical harmonics, from the first step on.
    densify_from: first step after which Gaussians may be added.
    densify_every: steps between densifications.
    densify_until: share of the budget after which none are added, so that positions and colours settle.
    expected_steps: number of steps that the budget is expected to allow.
    opacity_decay: factor on the opacities of Gaussians that stay at a densification. Training restores those that the
        photos need; the others are pruned.
    decay_within: distance from the origin of the training world, in its units, beyond which no opacity decays: most
        of the far shell is hidden from the photos, and decay would remove it. None: no such distance.
    annealing: how the learning rates fall.
    dropout: largest share of the Gaussians that a step leaves out at random; see `left_out`.
    in_view: how often a step has a given Gaussian in view, over how often it does in small captures (`share_in_view`).
    position_scale: factor on the learning rate of the positions, which is proportional to the extent of the scene: over
        that, the extent of what a photo has in view.
    earlier_visits: steps on each photo before the first of this run, for `dropout`: a tile starts from a model that has
        been trained on them.
    ends_at: steps after which few photos from one side end the run, whatever its budget; None where they do not.
    """

    budget: Budget
    resolution: tuple[tuple[int, int], ...]
    degree: int
    densify_from: int
    densify_every: int
    densify_until: float
    expected_steps: int
    opacity_decay: float = 1.0
    decay_within: float | None = None
    annealing: Annealing = field(default_factory=Annealing)
    dropout: float = 0.0
    longest: int | None = None
    ends_at: int | None = None
    in_view: float = 1.0
    position_scale: float = 1.0
    earlier_visits: float = 0.0

    def seen_by(self, photos: float, steps: int) -> Schedule:
        """The schedule for a part of the scene that this share of the photos shows, above 0, trained on these alone for
        so many steps. Where all photos show it, the schedule stays as it is, whatever the steps.
        """
        if photos == 1.0:
            return self
        share = min(1.0, self.in_view / photos)
        first, every = densification(steps, share)
        return replace(self, in_view=share, densify_from=first, densify_every=every)

    def course(self, steps: int, share: float) -> Schedule:
        """The schedule with the densification of so many steps, and this share in view; where all is, it stays as it
        is."""
        if self.in_view == 1.0:
            return self
        first, every = densification(steps, share)
        return replace(self, in_view=share, densify_from=first, densify_every=every)

    @property
    def reduced_until(self) -> int:
        """The last step on reduced photos."""
        return self.resolution[-1][0]

    def reduction(self, step: int) -> int:
        """The factor by which photos are reduced at `step` (1-based)."""
        return [factor for first, factor in self.resolution if first < step][-1]

    def left_out(self, visits: float) -> float:
        """The share of the Gaussians that a step leaves out at random after `visits` steps of this run on each photo.

        It grows from 0 at MANY_VISITS, with those of earlier runs, to `dropout` at twice as many.
        """
        return self.dropout * min(1.0, max(0.0, (self.earlier_visits + visits) / MANY_VISITS - 1.0))

    def unsettled(self, step: int, progress: float) -> bool:
        """Whether a densification was at most SETTLING of the way to the next one ago: opacities are still decayed."""
        since = (step - self.densify_from) % self.densify_every
        return (
            step >= self.densify_from
            and progress < self.densify_until
            and since < SETTLING * self.densify_every
        )

    def densifies(self, step: int, progress: float) -> bool:
        """Whether Gaussians may be added after `step`, at which the share `progress` of the budget is spent."""
        return (
            step >= self.densify_from
            and progress < self.densify_until
            and (step - self.densify_from) % self.densify_every == 0
        )
