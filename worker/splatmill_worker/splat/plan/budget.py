"""The budget of a run: steps or training seconds, whichever is spent first, and the clock that counts the seconds."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass


class Clock:
    """Wall-clock seconds of training. Evaluation, and all else that is not training, runs inside `stopped()`.

    seconds: those of earlier attempts, to which those of this one are added.
    """

    def __init__(self, seconds: float = 0.0) -> None:
        self._before = seconds
        self._since: float | None = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Training seconds so far, those of earlier attempts included."""
        return self._before + (0.0 if self._since is None else time.perf_counter() - self._since)

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """Do not count the time inside the context."""
        self._before, self._since = self.seconds, None
        try:
            yield
        finally:
            self._since = time.perf_counter()


@dataclass(frozen=True)
class Budget:
    """Limits of a run, at least one of which is given.

    steps: number of training steps.
    seconds: seconds of training.

    Under a time budget, progress is read from the clock and not predicted: whatever later steps cost, learning rates
    and stages reach their ends with the last second.
    """

    steps: int | None
    seconds: float | None = None

    def __post_init__(self) -> None:
        if self.steps is None and self.seconds is None:
            raise ValueError("a budget needs steps or seconds; neither was given.")

    def progress(self, step: int, seconds: float) -> float:
        """Share of the budget that `step` steps and `seconds` training seconds have spent, 0 to 1."""
        by_steps = 0.0 if self.steps is None else step / self.steps
        by_time = 0.0 if self.seconds is None else seconds / self.seconds
        return min(1.0, max(by_steps, by_time))

    def steps_left(self, step: int, seconds: float, each: float) -> float:
        """Number of steps that the rest of the budget allows, at `each` seconds per step."""
        by_steps = math.inf if self.steps is None else self.steps - step
        by_time = math.inf if self.seconds is None else (self.seconds - seconds) / each
        return max(0.0, min(by_steps, by_time))

    def ending_at(self, progress: float, tail: float) -> Budget:
        """The budget with which a run at `progress` ends after another share `tail` of what it has spent."""
        share = min(1.0, progress * (1.0 + tail))
        return Budget(
            None if self.steps is None else max(1, round(self.steps * share)),
            None if self.seconds is None else self.seconds * share,
        )
