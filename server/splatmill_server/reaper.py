"""The reaper: what nobody else in the system would notice.

A crashed worker's attempt is requeued, a job whose tries are used up becomes failed by name, a job the queue has lost
(a Redis that came back without its last second) is enqueued again, and a wish to cancel is repeated until no process
is left. Everything it does is safe to do twice, so each API process may run one.
"""

import asyncio
from collections.abc import Iterable

import redis
import structlog
from starlette.concurrency import run_in_threadpool

from splatmill.backplane import queue
from splatmill.backplane.row import JobRow
from splatmill.schema import Problem
from splatmill_server.jobs import Jobs, last_stage
from splatmill_server.metrics import Metrics
from splatmill_server.settings import Settings

log = structlog.get_logger()

_ENDED = {"finished", "failed", "stopped"}


class Reaper:
    """Ticks every few seconds, and a few times per second while a job is being cancelled."""

    def __init__(self, connection: redis.Redis, jobs: Jobs, metrics: Metrics, settings: Settings) -> None:
        self.connection = connection
        self.jobs = jobs
        self.metrics = metrics
        self.interval = settings.reaper_interval
        self.stop_interval = settings.stop_interval
        self._wake = asyncio.Event()
        # Jobs whose attempt had ended without a final state at the last tick: the state may still be on its way.
        self._silent: set[tuple[str, int]] = set()

    def wake(self) -> None:
        """A job is to be cancelled: do not wait for the next tick."""
        self._wake.set()

    async def run(self) -> None:
        """Tick until cancelled. Redis being away is no reason to stop."""
        while True:
            cancelling = False
            try:
                cancelling = await run_in_threadpool(self.tick)
            except redis.RedisError as error:
                log.warning("reaper cannot reach Redis", error=str(error))
            except Exception:
                log.exception("reaper tick failed")
            pause = self.stop_interval if cancelling else self.interval
            try:
                await asyncio.wait_for(self._wake.wait(), pause)
            except TimeoutError:
                continue
            self._wake.clear()

    def tick(self) -> bool:
        """Look at every unfinished job once; True while one is being cancelled."""
        queue.reclaim(self.connection)
        active = self.jobs.active()
        cancelling = [row for row in active if row.cancel_requested_at is not None]
        unfinished = [row for row in cancelling if not self.cancel(row)]
        self._look(row for row in active if row.cancel_requested_at is None)
        return bool(unfinished)

    def cancel(self, row: JobRow) -> bool:
        """Push a wish to cancel one step on; True once no process is left and the verdict is given."""
        place = queue.place(self.connection, row.id, row.generation)
        over = place.standing in _ENDED or place.standing == "absent"
        if not over:
            over = queue.withdraw(self.connection, row.id, row.generation)
        if over:
            self.jobs.end(row, "cancelled")
            log.info("job cancelled", job=row.id)
            return True
        queue.stop(self.connection, row.id, row.generation)
        return False

    def _look(self, rows: Iterable[JobRow]) -> None:
        silent = set()
        for row in rows:
            place = queue.place(self.connection, row.id, row.generation)
            if place.standing == "absent":
                if queue.enqueue(self.connection, row.id, row.generation):
                    self.metrics.requeued.inc()
                    log.warning("job was lost by the queue, enqueued again", job=row.id)
            elif place.standing in _ENDED:
                mark = (row.id, row.generation)
                if place.standing == "finished" and mark not in self._silent:
                    silent.add(mark)
                else:
                    self._give_up(row, place)
        self._silent = silent

    def _give_up(self, row: JobRow, place: queue.Place) -> None:
        job = self.jobs.get(row.id)
        facts = {"attempts": job.attempt, "stage": last_stage(job), "reason": place.reason}
        if place.standing == "failed":
            problem = Problem.of(
                "attempts_exhausted",
                f"The job's process died in {job.attempt} attempts"
                + (f", the last time during {facts['stage']}" if facts["stage"] else "")
                + (f" ({place.reason})" if place.reason else "")
                + ".",
                advice="Often the machine ran out of memory: try a smaller image_size or max_gaussians, "
                "then restart the job; it goes on from its last checkpoint.",
                facts=facts,
            )
        else:
            problem = Problem.of(
                "worker_lost",
                "The worker let go of the job without saying how it ended.",
                advice="Restart the job; it goes on from its last checkpoint.",
                facts=facts,
            )
        if self.jobs.end(row, "failed", problem):
            self.metrics.ended.labels(problem.code).inc()
            log.warning("job given up", job=row.id, code=problem.code, reason=place.reason)
