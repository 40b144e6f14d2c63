"""The state machine of the service: a job as clients see it, as a pure function of its row, states and progress.

- A restart begins a new generation; events of other generations are ignored.
- A later attempt supersedes an earlier one, whose process may still be appending events.
- Nothing follows the final state of a generation.
- Only the server makes a job cancelled, once no process of it is left; a worker's own `cancelled` is ignored.
"""

from collections.abc import Iterable
from datetime import datetime
from typing import Any

from splatmill.backplane.jobs.events import StoredEvent, stream_order
from splatmill.backplane.jobs.row import JobRow
from splatmill.schema import Job, JobState, PlanEvent, Problem, Progress, ProgressEvent, StateEvent


class Fold:
    """The state of one job, updated event by event, for a reader that follows the streams."""

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

    def counts(self, stored: StoredEvent) -> bool:
        """Return whether an event counts; not if its attempt is superseded or it follows the end of the job."""
        if stored.generation != self.row.generation or stored.attempt < self.attempt or self.final:
            return False
        event, verdict = stored.event, self.row.verdict
        if isinstance(event, StateEvent):
            late = verdict is not None and stored.order > stream_order(verdict.after)
            return not late and event.state is not JobState.cancelled
        return True

    def apply(self, stored: StoredEvent) -> bool:
        """Update the state by an event; return False if the event does not count."""
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
        """Apply the server's verdict. Return False if there is none, or if a worker's final state came first."""
        verdict = self.row.verdict
        if verdict is None or self.final:
            return False
        self.state = JobState(verdict.state)
        self.finished_at = verdict.at
        self.problem = verdict.problem
        return True

    def job(self) -> Job:
        """Return the job as clients see it now."""
        row = self.row
        return Job(
            id=row.id,
            capture=row.capture,
            name=row.name,
            tags=row.tags,
            favourite=row.favourite,
            owner=row.owner,
            state=self.state,
            options=row.options,
            priority=row.priority,
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


def fold(row: JobRow, states: Iterable[StoredEvent], last_progress: StoredEvent | None = None) -> Job:
    """Return the job that follows from its row, its states in stream order, and its newest progress."""
    folded = Fold(row)
    for stored in states:
        folded.apply(stored)
    # Progress has a stream of its own, so the newest one is applied even if a final state was reached.
    latest = last_progress
    if latest is not None and latest.generation == row.generation and latest.attempt >= folded.attempt:
        assert isinstance(latest.event, ProgressEvent)
        folded.progress = Progress.model_validate(latest.event.model_dump(exclude={"type"}))
    folded.close()
    return folded.job()
