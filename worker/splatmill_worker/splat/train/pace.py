"""How many steps a time budget holds: a forecast at first, then the measured pace (decisions: PACE)."""

from __future__ import annotations

from dataclasses import dataclass

from splatmill_worker.splat.plan.budget import Budget

RECENT = 100
"""Steps over which the pace is averaged: enough to level differences between photos, few enough to follow the growing
number of Gaussians."""


@dataclass
class Pace:
    """Seconds per step at the full training resolution.

    forecast: steps that the whole run was expected to take, used until RECENT steps were timed.
    seconds: mean duration of the last steps, seconds.
    count: steps that were timed.
    """

    forecast: int
    seconds: float = 0.0
    count: int = 0

    def record(self, seconds: float) -> None:
        """Add the duration of one step at the full resolution."""
        self.count += 1
        self.seconds += (seconds - self.seconds) / min(self.count, RECENT)

    def steps(self, budget: Budget, step: int, seconds: float) -> int:
        """Steps of the whole run, of which `step` are done after `seconds` of training."""
        if self.count < RECENT or self.seconds <= 0.0:
            return self.forecast
        return max(1, step + round(budget.steps_left(step, seconds, self.seconds)))
