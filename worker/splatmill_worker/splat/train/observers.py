"""What observes a run while its clock stands still: reports of progress, checkpoints, and others of the same kind."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from splatmill_worker.splat.train.run import TrainingRun
from splatmill_worker.splat.train.snapshot import Snapshot

PROGRESS_SECONDS = 0.5
"""Seconds between two reports of progress."""

CHECKPOINT_SECONDS = 20.0
"""Seconds between two checkpoints, at most."""

FIRST_CHECKPOINT_SECONDS = 2.5
"""Seconds until the first checkpoint. Each further interval equals the time from the beginning to the last checkpoint,
up to CHECKPOINT_SECONDS, so that an attempt which is lost early loses half of its work at most."""


class Observer(Protocol):
    """Observes a run after any of its steps, at moments of its own choice, while the training clock stands still."""

    def is_due(self, run: TrainingRun) -> bool:
        """Whether to observe the run now."""

    def observe(self, run: TrainingRun) -> None:
        """Observe the run."""


@dataclass(frozen=True)
class TrainingProgress:
    """Where a run stands.

    step: training steps so far.
    steps: steps of the whole run, estimated under a time budget. Where the budget may be doubled, they are those of the
        longest run until that is decided, so that the share which is done never falls.
    loss: training loss of the last step.
    gaussians: how many the scene has.
    seconds: training time so far.
    eta: training seconds to come, estimated.
    at_most: whether the run ends earlier where more steps would gain too little, so that `steps` and `eta` are bounds.
    """

    step: int
    steps: int
    loss: float
    gaussians: int
    seconds: float
    eta: float
    at_most: bool = False


class ProgressReports:
    """Reports where a run stands every PROGRESS_SECONDS."""

    def __init__(self, report: Callable[[TrainingProgress], None]) -> None:
        self._report, self._last = report, time.monotonic()

    def is_due(self, run: TrainingRun) -> bool:
        """Whether PROGRESS_SECONDS have passed since the last report."""
        return time.monotonic() - self._last >= PROGRESS_SECONDS

    def observe(self, run: TrainingRun) -> None:
        """Report."""
        self._last = time.monotonic()
        step, seconds = run.state.step, run.clock.seconds
        longest = run.longest
        progress = longest.progress(step, seconds)
        steps = max(step, step if progress <= 0 else round(step / progress))
        eta = seconds * (1.0 - progress) / max(progress, 1e-6)
        at_most = longest != run.state.budget
        self._report(TrainingProgress(step, steps, run.loss, run.engine.count, seconds, eta, at_most))


class Checkpoints:
    """Stores a run every `seconds`, sooner at first (FIRST_CHECKPOINT_SECONDS), and not once it has ended."""

    def __init__(self, store: Callable[[Snapshot], None], seconds: float = CHECKPOINT_SECONDS) -> None:
        self._store, self._seconds = store, seconds
        self._began = self._last = time.monotonic()

    def is_due(self, run: TrainingRun) -> bool:
        """Whether the next checkpoint is due."""
        gap = min(self._seconds, max(FIRST_CHECKPOINT_SECONDS, self._last - self._began))
        return not run.stopped and time.monotonic() - self._last >= gap

    def observe(self, run: TrainingRun) -> None:
        """Store the run as it is."""
        self._store(run.snapshot())
        self._last = time.monotonic()
