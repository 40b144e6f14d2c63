"""What is trained when: resolution, SH degree, densification, rates."""

from __future__ import annotations

from dataclasses import dataclass, field

from splatmill_worker.splat.budget import Budget
from splatmill_worker.splat.rates import Annealing


@dataclass(frozen=True)
class Schedule:
    """The course of a run, in shares of its budget where not said otherwise.

    resolution: (first step, reduction) pairs; photos are reduced by 4, then 2, then not at all, because early
    steps gain as much from a small photo as from a large one. degree_every: steps between SH degrees.
    degree_by: share of the budget in which a short one reaches its last degree. first_degree: that of the first step.
    opacity_decay: factor on the opacities of those Gaussians that stay when others are added: what the photos need
    grows back, what they do not is pruned.
    densify_from / densify_every in steps, densify_until as a share: after it, positions and colours settle.
    """

    budget: Budget
    resolution: tuple[tuple[int, int], ...]
    degree: int
    degree_every: int
    densify_from: int
    densify_every: int
    densify_until: float
    opacity_decay: float = 1.0
    degree_by: float = 1.0 / 3.0
    first_degree: int = 0
    annealing: Annealing = field(default_factory=Annealing)

    def reduction(self, step: int) -> int:
        """By how much photos are reduced at `step` (1-based)."""
        return [factor for first, factor in self.resolution if first < step][-1]

    def degree_at(self, step: int, progress: float) -> int:
        """SH degree in use."""
        by_steps = (step - 1) // self.degree_every
        by_share = int(progress * self.degree / self.degree_by)
        return min(self.degree, max(self.first_degree, by_steps, by_share))

    def densifies(self, step: int, progress: float) -> bool:
        """Whether the number of Gaussians may change after `step`."""
        return (
            step >= self.densify_from
            and progress < self.densify_until
            and (step - self.densify_from) % self.densify_every == 0
        )
