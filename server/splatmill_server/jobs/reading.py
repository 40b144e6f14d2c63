"""Jobs as Redis has them: row, states and newest progress of any number of jobs in one round trip."""

from collections.abc import Sequence
from dataclasses import dataclass

import redis

from splatmill.backplane import keys
from splatmill.backplane.jobs import events
from splatmill.backplane.jobs.events import StoredEvent
from splatmill.backplane.jobs.fold import fold
from splatmill.backplane.jobs.row import JobRow
from splatmill.backplane.storage.records import UnreadableRecord, warn
from splatmill.schema import BinKind, Job, JobState, StoredKind


@dataclass(frozen=True)
class Held:
    """What Redis holds of a job: its row, its states and its newest progress."""

    row: JobRow
    states: Sequence[StoredEvent]
    progress: StoredEvent | None

    @property
    def state(self) -> JobState:
        """The state of the job."""
        return fold(self.row, self.states).state

    def job(self) -> Job:
        """Return the job as clients see it, without links and its place in the queue."""
        return fold(self.row, self.states, self.progress)


def is_deleted(connection: redis.Redis, job_id: str) -> bool:
    """Return whether a job was deleted lately. That its row is missing is not enough: Redis may have lost it."""
    with connection.pipeline(transaction=False) as pipe:
        pipe.exists(keys.job(job_id))
        pipe.exists(keys.deleting(f"{StoredKind.model.value}/{job_id}"))
        known, marked = pipe.execute()
    return bool(marked and not known)


def read_jobs(
    connection: redis.Redis, job_ids: Sequence[str], *, without_bin: bool = False
) -> dict[str, Held]:
    """Return what Redis holds of these jobs, by id, in their order.

    Jobs without a row, or whose row is not readable, are left out; the latter are logged.

    without_bin: whether jobs in the bin are left out too.
    """
    with connection.pipeline(transaction=False) as pipe:
        for job_id in job_ids:
            pipe.hgetall(keys.job(job_id))
            pipe.xrange(keys.states(job_id))
            events.ask_progress(pipe, job_id)
            pipe.hexists(keys.BIN, keys.in_bin(BinKind.job, job_id))
        replies = iter(pipe.execute())
    jobs = {}
    for job_id, stored, states, progress, binned in zip(
        job_ids, replies, replies, replies, replies, strict=True
    ):
        if binned and without_bin:
            continue
        try:
            row = JobRow.of(stored)
        except UnreadableRecord as error:
            warn(f"job {job_id} is not listed", str(error))
            continue
        if row is not None:
            newest = events.answered_progress(progress, job_id)
            jobs[job_id] = Held(row, events.decode(states, keys.states(job_id)), newest)
    return jobs
