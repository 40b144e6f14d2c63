"""Simulated workers: those of the service, many in one process, whose attempts are threads and train nothing.

    python -m _fleet.workers COUNT

prints a JSON line once all have registered, another with what was counted since its start for each line that it reads,
and ends, as if killed, when there are no more. A worker registers, waits, takes jobs, sends heartbeats and settles by
the code of `splatmill_worker.service`, and its attempts are those of `run_attempt`, with the pipeline of this folder.
Left out are the fork, the limits of memory and time, and the processes that decode photos: they ask nothing of Redis.
"""

import copy
import json
import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast
from uuid import uuid4

from _capacity.operations import Operations, counted
from rq import Queue
from rq.executions import Execution
from rq.job import Job
from rq.timeouts import BaseDeathPenalty
from rq.utils import now

from _fleet import pipeline
from splatmill.backplane.connection import connect
from splatmill.backplane.queue import entries
from splatmill_worker.images.decoding import decoders
from splatmill_worker.service.lock import JobLock
from splatmill_worker.service.process_exit import ProcessExit
from splatmill_worker.service.rq_worker import AttemptWorker
from splatmill_worker.service.saved_progress import SavedProgress

_STACK_BYTES = 512 << 10  # a thousand workers have six thousand threads


class _NoTimeLimit(BaseDeathPenalty):
    """RQ's limit of time would set a signal; the service has none (JOB_TIMEOUT)."""

    def setup_death_penalty(self) -> None:
        """Do nothing."""

    def cancel_death_penalty(self) -> None:
        """Do nothing."""


class SimulatedWorker(AttemptWorker):
    """A worker whose attempts are threads."""

    death_penalty_class = _NoTimeLimit

    def __init__(self, url: str) -> None:
        super().__init__(connect(url), lambda: pipeline.run)
        self._url = url
        self._horse = threading.Thread()

    def procline(self, message: str) -> None:
        """Do nothing: a process of many workers keeps its title."""

    def _install_signal_handlers(self) -> None:
        """Do nothing: only the main thread of a process handles signals."""

    def fork_work_horse(self, job: Job, queue: Queue) -> None:
        """Start the attempt as a thread, with a copy of what a forked process has, and connections of its own."""
        job_id, _ = entries.split_rq_id(job.id)
        self._lock = JobLock(self.connection, job_id, uuid4().hex)
        self._saved = SavedProgress(job_id)
        self._horse = threading.Thread(target=self._attempt, args=(job,), daemon=True)
        self._horse.start()

    def _attempt(self, job: Job) -> None:
        horse, own = copy.copy(self), copy.copy(job)
        with connect(self._url) as connection:
            assert self.execution is not None
            horse.connection = own.connection = connection
            horse.queues = [entries.open_queue(connection)]
            horse.execution = Execution(self.execution.id, self.execution.job_id, connection, self.name)
            horse._run_child(own, horse.queues[0])

    def main_work_horse(self, job: Job, queue: Queue) -> None:
        """Perform the job, without the exit of a process."""
        self.perform_job(job, queue)

    def monitor_work_horse(self, job: Job, queue: Queue) -> None:
        """Wait for the attempt, sending heartbeats, and settle what it leaves."""
        job.started_at = now()
        self._horse.join(entries.MONITORING_INTERVAL)
        while self._horse.is_alive():
            self._heartbeat(job)
            self._horse.join(entries.MONITORING_INTERVAL)
        clean = ProcessExit(wait_status=0, peak_bytes=0, oom_kills=0)
        end = self._until_redis_works(lambda: self._settle(job, queue, clean))
        self._count(end, 0.0)


def counts(operations: Operations) -> dict[str, Any]:
    """Return what was counted so far, with the CPU seconds of this process."""
    return {
        "round_trips": operations.round_trips,
        "storage": sum(operations.storage.values()),
        "written": operations.written,
        "cpu_seconds": time.process_time(),
    }


def main(count: int) -> None:
    """Run workers until there are no more lines to read."""
    answers, sys.stdout = sys.stdout, sys.stderr  # RQ logs to the standard output
    threading.stack_size(_STACK_BYTES)
    logging.disable(logging.INFO)
    decoders.confined = _nothing_to_decode  # no photos, so no processes that decode them
    with counted() as operations:
        workers = [SimulatedWorker(os.environ["REDIS_URL"]) for _ in range(count)]
        born = [threading.Event() for _ in workers]
        for worker, event in zip(workers, born, strict=True):
            threading.Thread(target=_work, args=(worker, event), daemon=True).start()
        for event in born:
            event.wait()
        print(json.dumps(counts(operations)), file=answers, flush=True)
        for _ in sys.stdin:
            print(json.dumps(counts(operations)), file=answers, flush=True)


@contextmanager
def _nothing_to_decode(
    read: list[Path],
    ended: Path | None = None,
    cancelled: Callable[[], bool] = lambda: False,
    *,
    keep_reader: bool = False,
) -> Iterator[decoders.Decoders]:
    yield cast(decoders.Decoders, None)  # an attempt does not use it


def _work(worker: SimulatedWorker, born: threading.Event) -> None:
    """Let a worker work, and tell when it has registered."""
    subscribe = worker.subscribe

    def subscribed() -> None:
        subscribe()  # type: ignore[no-untyped-call]  # RQ leaves it untyped
        born.set()

    worker.subscribe = subscribed  # type: ignore[method-assign]  # bootstrap ends with it
    worker.work(logging_level="WARNING")


if __name__ == "__main__":
    main(int(sys.argv[1]))
