"""The reaper, which repairs what workers and the queue cannot.

It restores what Redis has lost, requeues the attempts of crashed workers, fails jobs whose attempts are used up,
enqueues jobs again that the queue has lost (Redis may restart without its last second of writes), and repeats the
cancellation of a job until no process is left. Its actions are idempotent, so every API process may run one. It takes a
few round trips however many jobs wait or run, and some more for each job that needs its attention.
"""

import asyncio
import time
from collections.abc import Callable, Iterable, Mapping
from typing import TypeVar

import redis
import structlog
from starlette.concurrency import run_in_threadpool

from splatmill.backplane import expiry, keys
from splatmill.backplane.jobs.published import is_published
from splatmill.backplane.jobs.row import JobRow
from splatmill.backplane.queue import entries, leases, lines, queue
from splatmill.backplane.storage.storage import StorageError
from splatmill.schema import Problem
from splatmill_server.base.metrics import Metrics
from splatmill_server.base.problems import ProblemError
from splatmill_server.base.settings import Settings
from splatmill_server.jobs import requests, restoring, shrinking
from splatmill_server.jobs.records import Jobs, last_stage

log = structlog.get_logger()

T = TypeVar("T")

_LOST_SECONDS = 60.0
"""Seconds between two looks for single jobs that Redis has lost."""

_ENDED = {"finished", "failed", "stopped"}


class Reaper:
    """Checks all unfinished jobs every few seconds, and more often while a job is being cancelled."""

    def __init__(self, connection: redis.Redis, jobs: Jobs, metrics: Metrics, settings: Settings) -> None:
        self.connection = connection
        self.jobs = jobs
        self.metrics = metrics
        self.leases = leases.Reclaim(connection)
        self.interval = settings.reaper_interval
        self.stop_interval = settings.stop_interval
        self.pause = self.interval
        """Seconds after which to look again, as the last look found."""
        self._wake = asyncio.Event()
        # Jobs whose attempt had ended without a final state at the last check: the state may still arrive.
        self._unreported: set[tuple[str, int]] = set()
        # Jobs that are in storage and had no row at the last look.
        self._missing: set[str] = set()
        self._looked_at = float("-inf")

    def wake(self) -> None:
        """Check now, because a job is to be cancelled."""
        self._wake.set()

    async def run(self) -> None:
        """Check the jobs until this task is cancelled, also while Redis cannot be reached."""
        while True:
            try:
                await run_in_threadpool(self.tick)
            except redis.RedisError as error:
                log.warning("reaper cannot reach Redis", error=str(error))
            except Exception:
                log.exception("reaper tick failed")
            try:
                async with asyncio.timeout(self.pause):
                    await self._wake.wait()
            except TimeoutError:
                continue
            self._wake.clear()

    def tick(self) -> bool:
        """Check every unfinished job once; return True while one is being cancelled."""
        self.pause = self.interval
        self._restore()
        if self.leases.run():
            lines.sort(self.connection)
        rows = {entries.rq_id(row.id, row.generation): row for row in self.jobs.list_active()}
        states = dict(
            zip(
                rows,
                queue.states(self.connection, [(row.id, row.generation) for row in rows.values()]),
                strict=True,
            )
        )
        self._drop_unheld(rows, states)
        cancelling = [row for row in rows.values() if row.cancel_requested_at is not None]
        unfinished = [row for row in cancelling if not _safely(self.cancel, row, True)]
        for row in cancelling:
            if (
                row not in unfinished
            ):  # stored at once: a Redis that comes back empty would have the job run again
                self.jobs.retire(row.id)
        self._check(
            row
            for entry, row in rows.items()
            if row.cancel_requested_at is None and states[entry] not in ("waiting", "running")
        )
        shrinking.shrink_due(self.connection)
        if unfinished:
            self.pause = self.stop_interval
        return bool(unfinished)

    def _restore(self) -> None:
        """Make the lists where Redis has lost them, and restore single jobs that it has lost.

        A job counts as lost if two looks do not find its row, because one is stored before it is inserted.
        """
        try:
            self.jobs.lists.ensure(wait=0.0)
            if time.monotonic() - self._looked_at < _LOST_SECONDS:
                return
            self._looked_at = time.monotonic()
            missing = set(restoring.without_row(self.connection, requests.list_ids(self.jobs.storage)))
        except ProblemError:
            return  # another process makes the lists
        except StorageError as error:
            log.warning("storage cannot be searched for lost jobs", error=str(error))
            return
        self.jobs.restore(sorted(missing & self._missing))
        self._missing = missing

    def _drop_unheld(self, rows: Mapping[str, JobRow], states: dict[str, queue.QueueState]) -> None:
        """Delete RQ's records of the entries that are marked as started and that no worker holds a lease on.

        rows, states: of unfinished jobs, by entry. The states of the deleted ones become "absent".

        A worker that is killed soon after Redis came back empty leaves one: RQ records that its attempt has started,
        and its lease is lost.
        """
        running = {entry for entry, state in states.items() if state == "running"}
        held = {lease.entry for lease in leases.held(self.connection)} if running else set()
        for entry in sorted(running - held):
            # The worker of a job that was just restored may take its lease again.
            if not self._is_restored(rows[entry].id) and leases.drop_unheld(self.connection, entry):
                states[entry] = "absent"
                log.warning(
                    "the queue lists a job as running, but no worker holds a lease on it", job=rows[entry].id
                )

    def cancel(self, row: JobRow) -> bool:
        """Take the next step of a cancellation; return True once no process is left and the job has ended."""
        status = queue.status(self.connection, row.id, row.generation)
        withdrawn = queue.withdraw(
            self.connection, row.id, row.generation
        )  # from its line even without a record
        queue.withdraw_tiles(self.connection, row.id, row.generation, row.options.tiles)
        absent = status.state == "absent" and not self._is_restored(row.id)
        if withdrawn or status.state in _ENDED or absent:
            try:
                succeeded = self._has_succeeded(row)
            except StorageError as error:
                # A job that waits is cancelled also while storage does not answer.
                if not withdrawn:
                    raise
                log.warning(
                    "storage does not say whether a cancelled job has a model", job=row.id, error=str(error)
                )
                succeeded = False
            if not succeeded:
                self.jobs.give_verdict(row, "cancelled")
                log.info("job cancelled", job=row.id)
            return True
        queue.stop(self.connection, row.id, row.generation)
        return False

    def _is_restored(self, job_id: str) -> bool:
        """Return whether a job was restored so lately that a process may run it which the queue does not know.

        The next look then comes when that time is over.
        """
        expiry.shorten(self.connection, keys.RESTORED, restoring.GRACE)
        if not self.connection.sismember(keys.RESTORED, job_id):
            return False
        self.pause = min(self.pause, max(self.connection.pttl(keys.RESTORED), 0) / 1000 + 0.01)
        return True

    def _check(self, rows: Iterable[JobRow]) -> None:
        # In the order in which they were queued, since that becomes their order in the queue.
        looked = sorted(rows, key=lambda row: row.queued_at)
        self._unreported = {
            mark for row in looked if (mark := _safely(self._check_one, row, None)) is not None
        }

    def _check_one(self, row: JobRow) -> tuple[str, int] | None:
        """Repair one job. Return its mark if its attempt has ended and its final state may still arrive."""
        status = queue.status(self.connection, row.id, row.generation)
        if status.state == "absent":
            if not self._is_restored(row.id) and queue.enqueue(self.connection, row.id, row.generation):
                self.metrics.requeued.inc()
                log.warning("job was lost by the queue, enqueued again", job=row.id)
        elif status.state in _ENDED:
            mark = (row.id, row.generation)
            if status.state == "finished" and mark not in self._unreported:
                return mark
            self._give_up(row, status)
        return None

    def _has_succeeded(self, row: JobRow) -> bool:
        """End a job as succeeded if its model is stored: its attempt ended, or Redis was emptied, before it said so."""
        published = is_published(self.jobs.storage, row.id, row.generation)
        if published and self.jobs.give_verdict(row, "succeeded"):
            log.warning("job had stored its model and was not reported as succeeded", job=row.id)
        return published

    def _give_up(self, row: JobRow, status: queue.QueueStatus) -> None:
        queue.withdraw_tiles(self.connection, row.id, row.generation, row.options.tiles)
        if self._has_succeeded(row):
            self.jobs.retire(row.id)
            return
        job = self.jobs.get(row.id)
        facts = {"attempts": job.attempt, "stage": last_stage(job), "reason": status.reason}
        lost = leases.lost(self.connection, entries.rq_id(row.id, row.generation))
        during = f" during {facts['stage']}" if facts["stage"] else ""
        if status.state == "failed" and lost >= leases.MAX_LOST:
            problem = Problem.of(
                "attempts_exhausted",
                f"The worker that ran the job was lost {lost} times in a row{during}, each time without a new "
                "checkpoint.",
                advice="Probably the job itself ends the worker or its machine, by taking all memory: start a new job "
                "with a smaller image_size or max_gaussians, or give the worker a limit of memory.",
                facts=facts | {"lost_workers": lost},
            )
        elif status.state == "failed":
            problem = Problem.of(
                "attempts_exhausted",
                f"The job's process ended unexpectedly in each of {job.attempt} attempts"
                + (f", the last time{during}" if during else "")
                + (f" ({status.reason})" if status.reason else "")
                + ".",
                advice="Often the machine has run out of memory: start a new job with a smaller "
                "image_size or "
                "max_gaussians. A restart resumes from the last checkpoint, with the same options.",
                facts=facts,
            )
        else:
            problem = Problem.of(
                "worker_lost",
                "The worker released the job without reporting how it ended.",
                advice="Restart the job; it resumes from its last checkpoint.",
                facts=facts,
            )
        if self.jobs.give_verdict(row, "failed", problem):
            self.metrics.ended.labels(problem.code).inc()
            log.warning("job given up", job=row.id, code=problem.code, reason=status.reason)
            self.jobs.retire(row.id)


def _safely(step: Callable[[JobRow], T], row: JobRow, otherwise: T) -> T:
    """Return the result of a step on one job. An error in it is logged, so that it does not affect other jobs.

    Raises redis.RedisError, which affects all.
    """
    try:
        return step(row)
    except redis.RedisError:
        raise
    except Exception:
        log.exception("job could not be checked", job=row.id)
        return otherwise
