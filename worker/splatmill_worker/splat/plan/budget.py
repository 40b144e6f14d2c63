"""How much may be spent, and how much of it is: steps or training seconds, whichever ends first."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass


class Clock:
    """Wall seconds of training; evaluation and whatever else is not training happens inside `stopped()`."""

    def __init__(self, seconds: float = 0.0) -> None:
        self._before = seconds
        self._since: float | None = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Training seconds so far, those of earlier attempts included."""
        return self._before + (0.0 if self._since is None else time.perf_counter() - self._since)

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """Time inside is not counted."""
        self._before, self._since = self.seconds, None
        try:
            yield
        finally:
            self._since = time.perf_counter()


@dataclass(frozen=True)
class Budget:
    """`steps` and `seconds` are limits; at least one is given.

    With a time budget the share spent is read from the clock, not predicted: whatever a step costs later, rates
    and stages arrive at their ends together with the last second.
    """

    steps: int | None
    seconds: float | None = None

    def __post_init__(self) -> None:
        if self.steps is None and self.seconds is None:
            raise ValueError("a budget needs steps or seconds; neither was given.")

    def progress(self, step: int, seconds: float) -> float:
        """Share of the budget spent after `step` steps and `seconds` training seconds, 0..1."""
        by_steps = 0.0 if self.steps is None else step / self.steps
        by_time = 0.0 if self.seconds is None else seconds / self.seconds
        return min(1.0, max(by_steps, by_time))

    def steps_left(self, step: int, seconds: float, each: float) -> float:
        """Steps that what is left of the budget is worth, at `each` seconds a step."""
        by_steps = math.inf if self.steps is None else self.steps - step
        by_time = math.inf if self.seconds is None else (self.seconds - seconds) / each
        return max(0.0, min(by_steps, by_time))

    def ending_at(self, progress: float, tail: float) -> Budget:
        """The budget that makes a run at `progress` end after another `tail` of what it has spent so far."""
        share = min(1.0, progress * (1.0 + tail))
        return Budget(
            None if self.steps is None else max(1, round(self.steps * share)),
            None if self.seconds is None else self.seconds * share,
        )
