"""Times on a device. In the interpreter nothing is timed: what it takes says nothing of a GPU."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class Place:
    """Where the parts of the benchmark run.

    device: `cuda`, or `cpu` for Triton's interpreter.
    dry: sizes are tiny, and nothing is timed.
    """

    device: str
    dry: bool

    def median_ms(self, work: Callable[[], object], repeats: int = 20) -> float | None:
        """Median milliseconds on the device of `work`, after three calls that compile and tune; None in a dry run."""
        if self.dry:
            work()
            return None
        for _ in range(3):
            work()
        taken = []
        for _ in range(repeats):
            start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))  # type: ignore[no-untyped-call]  # torch's own gap
            start.record()
            work()
            end.record()
            end.synchronize()
            taken.append(start.elapsed_time(end))
        return float(statistics.median(taken))

    def host_ms(self, work: Callable[[], object], repeats: int = 6) -> float | None:
        """Median milliseconds that the host takes to enqueue `work`, no more often than a step may be ahead."""
        if self.dry:
            return None
        taken = []
        for _ in range(repeats):
            torch.cuda.synchronize()
            started = time.perf_counter()
            work()
            taken.append(1e3 * (time.perf_counter() - started))
        return float(statistics.median(taken))
