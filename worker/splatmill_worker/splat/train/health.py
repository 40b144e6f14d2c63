"""Watches the loss of every step, and ends training by name when it diverges; and counts values that are not finite."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torch import Tensor

from splatmill_worker.errors import FailureName, TrainingFailed

SMOOTHING = 0.95
"""Weight of the past in the smoothed loss: a mean over about 20 steps, because losses of single photos differ by a
factor of a few."""

DIVERGENCE_RATIO, DIVERGENCE_MARGIN = 3.0, 0.05
"""A smoothed loss above its lowest value times DIVERGENCE_RATIO plus DIVERGENCE_MARGIN is a divergence."""

GOOD_RATIO, GOOD_MARGIN = 1.2, 0.01
"""A smoothed loss up to its lowest value times GOOD_RATIO plus GOOD_MARGIN marks a state worth a snapshot."""

GRACE_STEPS = 100
"""Steps at the start, after a change of resolution and after a resumption in which the loss may rise."""

EMPTY_STEPS = 200
"""Steps in a row whose photo shows no Gaussian, after which the scene counts as empty."""


@dataclass
class LossHealth:
    """The course of the loss.

    smoothed: exponential mean of the loss; None before the first step.
    lowest: lowest smoothed loss since checks began; infinite before.
    checked_from: number of the step from which a rise of the loss is a divergence.
    empty_steps: steps in a row, up to the last one, whose photo showed no Gaussian.
    """

    smoothed: float | None = None
    lowest: float = math.inf
    checked_from: int = GRACE_STEPS
    empty_steps: int = 0

    @property
    def near_lowest(self) -> bool:
        """Whether the smoothed loss is close enough to its lowest value for a snapshot to roll back to."""
        return self.smoothed is not None and self.smoothed <= GOOD_RATIO * self.lowest + GOOD_MARGIN

    def expect_rise(self, step: int) -> None:
        """Forget the lowest loss, and allow a rise for GRACE_STEPS from `step`."""
        self.checked_from = step + GRACE_STEPS
        self.lowest = math.inf

    def check(self, step: int, loss: float, visible: int) -> None:
        """Take in the loss of `step` and the number of Gaussians that its photo showed.

        Raises TrainingFailed: non_finite, empty_scene or divergence.
        """
        if not math.isfinite(loss):
            raise TrainingFailed(FailureName.non_finite, f"the loss became {loss}.", step=step)
        self.empty_steps = self.empty_steps + 1 if visible == 0 else 0
        if self.empty_steps >= EMPTY_STEPS:
            symptom = f"none of the last {EMPTY_STEPS} photos showed any Gaussian."
            raise TrainingFailed(FailureName.empty_scene, symptom, step=step)
        self.smoothed = (
            loss if self.smoothed is None else SMOOTHING * self.smoothed + (1.0 - SMOOTHING) * loss
        )
        if step < self.checked_from:
            return
        self.lowest = min(self.lowest, self.smoothed)
        if (
            not self.smoothed <= DIVERGENCE_RATIO * self.lowest + DIVERGENCE_MARGIN
        ):  # written so that NaN fails
            symptom = f"the loss rose from {self.lowest:.3f} to {self.smoothed:.3f}."
            raise TrainingFailed(FailureName.divergence, symptom, step=step)


def not_finite(values: Tensor) -> int:
    """How many of the values are infinite or NaN.

    Their sum is not finite where one of them is not, and takes a thirtieth of the time of looking at each.
    """
    if bool(values.sum().isfinite()):
        return 0
    return int((~values.isfinite()).sum())
