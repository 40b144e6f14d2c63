"""How many steps a time budget turns out to hold: a forecast, corrected by the steps that were timed."""

from __future__ import annotations

from dataclasses import dataclass

from splatmill_worker.splat.plan.budget import Budget

RECENT = 100
"""Steps that the present pace is the mean of: enough to level the photos, and where Gaussians were added."""


@dataclass
class Pace:
    """`forecast` steps are believed until RECENT steps were timed; each step at full size is told to `timed`."""

    forecast: int
    seconds: float = 0.0
    count: int = 0

    def timed(self, seconds: float) -> None:
        """One more step took so long."""
        self.count += 1
        self.seconds += (seconds - self.seconds) / min(self.count, RECENT)

    def steps(self, budget: Budget, step: int, seconds: float) -> int:
        """All steps of a run that has done `step` of them in `seconds`."""
        if self.count < RECENT or self.seconds <= 0.0:
            return self.forecast
        return max(1, step + round(budget.steps_left(step, seconds, self.seconds)))
