"""How long a stage will still take, by the times that this machine needed for its parts so far."""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass, field

LEAST_SHARE = 0.02
"""Share of a stage that must be done before its remaining time is known."""

LEAST_SECONDS = 1.0
"""Seconds of a stage that must have passed."""

LARGEST_EXPONENT = 2.0
"""The time of a stage grows at most with the square of the number of photos: placing one more adjusts all others."""


@dataclass
class StagePace:
    """The course of one stage: seconds since its first report at which so much was done.

    Time is taken to grow as a power of what is done, which the times of the whole and of its first half give: 1 for
    features and matches, about 1.6 for placing photos.
    """

    began: float
    done: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def add(self, done: int, now: float) -> None:
        """Note that `done` was reached. A number below the last one begins the stage anew."""
        if self.done and done < self.done[-1]:
            self.began = now
            self.done.clear()
            self.seconds.clear()
        if self.done and done == self.done[-1]:
            self.seconds[-1] = now - self.began
            return
        self.done.append(done)
        self.seconds.append(now - self.began)

    def remaining(self, total: int) -> float | None:
        """Seconds until `total` is reached; None while too little is done to say."""
        if not self.done or total <= 0:
            return None
        done, seconds = self.done[-1], self.seconds[-1]
        if done >= total or done < LEAST_SHARE * total or seconds < LEAST_SECONDS:
            return None
        return float(seconds * ((total / done) ** self._exponent() - 1.0))

    def _exponent(self) -> float:
        done, seconds = self.done[-1], self.seconds[-1]
        half = bisect_left(self.done, done / 2)
        if half == len(self.done) - 1 or self.seconds[half] <= 0.0 or self.done[half] <= 0:
            return 1.0
        exponent = math.log(seconds / self.seconds[half]) / math.log(done / self.done[half])
        return min(max(exponent, 1.0), LARGEST_EXPONENT)
