"""What a client sees of a job, as a pure function of the row, the states and the last progress.

The state machine of the service lives here and nowhere else:

- a restart is a new generation; events of other generations do not count;
- a later attempt wins over an earlier one, whose process may still be writing;
- nothing follows the final state of a generation;
- `cancelled` is the server's word alone, given once no process is left; a worker's own is not final.
"""

from collections.abc import Iterable
from datetime import datetime
from typing import Any

from splatmill.backplane.events import Stored, stream_order
from splatmill.backplane.row import JobRow
from splatmill.schema import Job, JobState, PlanEvent, Problem, Progress, ProgressEvent, StateEvent


class Fold:
    """The fold, one event at a time, for a reader that follows the streams."""

    def __init__(self, row: JobRow) -> None:
        self.row = row
        self.state = JobState.queued
        self.attempt = 0
        self.started_at: datetime | None = None
        self.finished_at: datetime | None = None
        self.problem: Problem | None = None
        self.plan: dict[str, Any] | None = None
        self.progress: Progress | None = None

    @property
    def final(self) -> bool:
        return self.state.final

    def counts(self, stored: Stored) -> bool:
        """Whether an event changes what a client sees, or comes from a superseded attempt or too late."""
        if stored.generation != self.row.generation or stored.attempt < self.attempt or self.final:
            return False
        event, verdict = stored.event, self.row.verdict
        if isinstance(event, StateEvent):
            late = verdict is not None and stored.order > stream_order(verdict.after)
            return not late and event.state is not JobState.cancelled
        return True

    def apply(self, stored: Stored) -> bool:
        """Take an event into account; False when it does not count."""
        if not self.counts(stored):
            return False
        event = stored.event
        if isinstance(event, StateEvent | PlanEvent):
            self.attempt = stored.attempt
        if isinstance(event, StateEvent):
            self.state = event.state
            self.problem = event.problem if event.state is JobState.failed else None
            if event.state is not JobState.queued:
                self.started_at = self.started_at or stored.at
            if event.state.final:
                self.finished_at = stored.at
        elif isinstance(event, PlanEvent):
            self.plan = event.plan
        elif isinstance(event, ProgressEvent):
            self.progress = Progress.model_validate(event.model_dump(exclude={"type"}))
        return True

    def close(self) -> bool:
        """Apply the server's verdict, if there is one and no worker's final state came before it."""
        verdict = self.row.verdict
        if verdict is None or self.final:
            return False
        self.state = JobState(verdict.state)
        self.finished_at = verdict.at
        self.problem = verdict.problem
        return True

    def job(self) -> Job:
        """The job as a client sees it now."""
        row = self.row
        return Job(
            id=row.id,
            capture=row.capture,
            name=row.name,
            state=self.state,
            options=row.options,
            created_at=row.created_at,
            started_at=self.started_at,
            finished_at=self.finished_at,
            attempt=self.attempt,
            cancel_requested=row.cancel_requested_at is not None,
            progress=self.progress,
            plan=self.plan,
            problem=self.problem,
            model=row.id if self.state is JobState.succeeded else None,
        )


def fold(row: JobRow, states: Iterable[Stored], last_progress: Stored | None = None) -> Job:
    """The job that a row, its states (in stream order) and its newest progress amount to."""
    folded = Fold(row)
    for stored in states:
        folded.apply(stored)
    # Progress lies in a stream of its own: the newest one says how far things were even after the final state.
    latest = last_progress
    if latest is not None and latest.generation == row.generation and latest.attempt >= folded.attempt:
        assert isinstance(latest.event, ProgressEvent)
        folded.progress = Progress.model_validate(latest.event.model_dump(exclude={"type"}))
    folded.close()
    return folded.job()
