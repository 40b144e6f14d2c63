"""Where waiting jobs stand in the queue: their position, when they will probably start, and what they wait for."""

import time
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta

import redis

from splatmill.backplane.queue import leases, lines, workers
from splatmill.backplane.queue.entries import rq_id
from splatmill.backplane.queue.lines import Line, Waiting
from splatmill.backplane.queue.workers import WorkerRecord
from splatmill.backplane.refusal import RedisRefuses
from splatmill.schema import Job, JobState

_FRESH_SECONDS_EACH = 0.001
"""Seconds for which a reading of the workers serves, for each worker that it has found. To read one takes some 40
microseconds."""


class QueuePlaces:
    """Computes the places in the queue of waiting jobs, for one service.

    What workers there are, and what they run, is kept for a time that grows with their number: where there are a
    thousand, it is read once a second, and not for each job that is created or looked at.
    """

    def __init__(self, connection: redis.Redis) -> None:
        self._connection = connection
        self._fleet: _Fleet | None = None
        self._fresh_until = float("-inf")

    def fill(self, jobs: Sequence[tuple[Job, int]]) -> list[Job]:
        """Return the jobs, with the places in the queue of those that wait.

        jobs: each with its generation.

        The queue is read once for all of them.
        """
        entries = [
            rq_id(job.id, generation) if job.state is JobState.queued else "" for job, generation in jobs
        ]
        if not (asked := [entry for entry in entries if entry]):
            return [job for job, _ in jobs]
        try:
            waiting = lines.look(self._connection, asked)
        except RedisRefuses:
            # What has just arrived cannot be sorted into its line; the jobs can be read all the same.
            return [job for job, _ in jobs]
        fleet = self._read() if waiting.places else None
        return [
            job.model_copy(update=fleet.place(waiting, entry)) if fleet and entry in waiting.places else job
            for (job, _), entry in zip(jobs, entries, strict=True)
        ]

    def _read(self) -> "_Fleet":
        fleet = self._fleet
        if fleet is None or time.monotonic() >= self._fresh_until:
            self._fleet = fleet = _Fleet(self._connection)
            self._fresh_until = time.monotonic() + _FRESH_SECONDS_EACH * fleet.count
        return fleet


def start_after(position: int, seconds: float, free_after: Sequence[float]) -> float:
    """Return in how many seconds a job starts.

    position: number of jobs before it.
    seconds: how long a job takes.
    free_after: for each worker, the seconds until it has finished its present job, at most `seconds`.
    """
    rounds, worker = divmod(position, len(free_after))
    return sorted(free_after)[worker] + rounds * seconds


class _Fleet:
    """The workers at one moment, and since when each runs what it runs."""

    def __init__(self, connection: redis.Redis) -> None:
        self._workers = workers.listening(connection)
        self._running = leases.running(connection)
        self._durations = lines.mean_durations(connection)
        seconds, micros = connection.time()
        self._read_at = datetime.fromtimestamp(seconds + micros / 1e6, UTC)

    @property
    def count(self) -> int:
        """Number of workers."""
        return len(self._workers)

    def place(self, waiting: Waiting, entry: str) -> dict[str, object]:
        """Return the fields of a job for an entry that waits."""
        line = waiting.places[entry].line
        serving = workers.serving(self._workers, line)
        served = {other for worker in serving for other in worker.lines}
        position = waiting.position(entry, served)
        assert position is not None
        return {
            "queue_position": position,
            "estimated_start": self._start(line, position, serving),
            "waiting_for": None if serving else line,
        }

    def _start(self, line: Line, position: int, serving: Sequence[WorkerRecord]) -> datetime | None:
        seconds = self._durations.get(line)
        if not serving or seconds is None:
            return None
        free_after = [
            max(0.0, seconds - self._running[worker.name]) if worker.name in self._running else 0.0
            for worker in serving
        ]
        start = self._read_at + timedelta(seconds=start_after(position, seconds, free_after))
        return start.replace(microsecond=0)
