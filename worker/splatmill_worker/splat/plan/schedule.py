"""What is trained when: resolution, SH degree, densification, rates."""

from __future__ import annotations

from dataclasses import dataclass, field

from splatmill_worker.splat.plan.budget import Budget
from splatmill_worker.splat.plan.rates import Annealing


@dataclass(frozen=True)
class Schedule:
    """The course of a run, in shares of its budget where not said otherwise.

    resolution: (first step, reduction) pairs; photos are reduced by 4, then 2, then not at all, because early
    steps gain as much from a small photo as from a large one. degree: of the spherical harmonics, from the first step.
    opacity_decay: factor on the opacities of those Gaussians that stay when others are added: what the photos need
    grows back, what they do not is pruned.
    decay_within: distance from the origin of the training world beyond which no opacity decays: the far shell is mostly
    hidden from the photos, and is there for what they do not show. None: everywhere.
    expected_steps: what the budget is laid out for.
    densify_from / densify_every in steps, densify_until as a share: after it, positions and colours settle.
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

    def reduction(self, step: int) -> int:
        """By how much photos are reduced at `step` (1-based)."""
        return [factor for first, factor in self.resolution if first < step][-1]

    def densifies(self, step: int, progress: float) -> bool:
        """Whether the number of Gaussians may change after `step`."""
        return (
            step >= self.densify_from
            and progress < self.densify_until
            and (step - self.densify_from) % self.densify_every == 0
        )
