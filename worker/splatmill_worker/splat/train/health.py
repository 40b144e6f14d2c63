"""Is the optimisation still going somewhere? Watches the loss and the parameters, and names what went wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass

from splatmill_worker.errors import FailureName, TrainingFailed

MEMORY = 0.95
"""Weight of the past in the smoothed loss: about 20 steps, since single photos differ by a factor of a few."""

RISE = 3.0
"""A smoothed loss this many times its lowest value (plus MARGIN) is a divergence."""

MARGIN = 0.05

GOOD, GOOD_MARGIN = 1.2, 0.01
"""A state is good while the smoothed loss is within this of its lowest."""

GRACE = 100
"""Steps after a disturbance (an opacity reset, another resolution) in which a rise is expected."""

BLIND = 200
"""Steps in a row that see no Gaussian at all."""


@dataclass
class Health:
    """Fed with every step's loss; raises TrainingFailed by name."""

    smoothed: float | None = None
    lowest: float = math.inf
    calm_from: int = GRACE
    blind: int = 0

    @property
    def well(self) -> bool:
        """Whether the loss is near its lowest: a state worth going back to."""
        return self.smoothed is not None and self.smoothed <= GOOD * self.lowest + GOOD_MARGIN

    def disturbed(self, step: int) -> None:
        """The loss is about to rise for a reason that is known."""
        self.calm_from = step + GRACE
        self.lowest = math.inf

    def watch(self, step: int, loss: float, visible: int) -> None:
        """Judge one step."""
        if not math.isfinite(loss):
            raise TrainingFailed(FailureName.non_finite, f"the loss became {loss}.", step=step)
        self.blind = self.blind + 1 if visible == 0 else 0
        if self.blind >= BLIND:
            seen = f"none of the last {BLIND} photos showed any Gaussian."
            raise TrainingFailed(FailureName.empty_scene, seen, step=step)
        self.smoothed = loss if self.smoothed is None else MEMORY * self.smoothed + (1.0 - MEMORY) * loss
        if step < self.calm_from:
            return
        self.lowest = min(self.lowest, self.smoothed)
        if not self.smoothed <= RISE * self.lowest + MARGIN:
            seen = f"the loss rose from {self.lowest:.3f} to {self.smoothed:.3f}."
            raise TrainingFailed(FailureName.divergence, seen, step=step)
