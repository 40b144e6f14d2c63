"""The job queue as the server uses it: enqueue, look, withdraw, stop and forget a generation of a job.

RQ keeps the record of each entry (`entries`) and starts attempts. `lines` decide which entry is next, `leases` whether
its worker is alive.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import redis
from rq import Retry
from rq.command import send_stop_job_command
from rq.exceptions import DuplicateJobError, InvalidJobOperation, NoSuchJobError
from rq.job import Job, JobStatus

from splatmill.backplane.queue import leases, lines
from splatmill.backplane.queue.entries import (
    ATTEMPT,
    JOB_TIMEOUT,
    KEEP_FINISHED,
    KEEP_TILES,
    MAX_RETRIES,
    SERIALIZER,
    UNITS_PER_TILE,
    QueueEntry,
    open_queue,
    rq_id,
    unit_id,
)

QueueState = Literal["waiting", "running", "finished", "failed", "stopped", "absent"]
"""State of a generation in the queue. `failed`: all attempts were used up, or its worker was lost too often. `stopped`:
it was killed on request or withdrawn, and no process of it is left. `absent`: RQ has no record of it."""

_STATES: dict[JobStatus, QueueState] = {
    JobStatus.QUEUED: "waiting",
    JobStatus.DEFERRED: "waiting",
    JobStatus.SCHEDULED: "waiting",
    JobStatus.STARTED: "running",
    JobStatus.FINISHED: "finished",
    JobStatus.FAILED: "failed",
    JobStatus.STOPPED: "stopped",
    JobStatus.CANCELED: "stopped",
}


@dataclass(frozen=True)
class QueueStatus:
    """What the queue knows about a generation.

    state: its state in the queue.
    worker: name of the worker that runs it.
    reason: last line of RQ's error message if it failed.
    """

    state: QueueState
    worker: str | None = None
    reason: str | None = None


def enqueue(connection: redis.Redis, job_id: str, generation: int) -> bool:
    """Append a generation to the line that its row names (see `lines`).

    Return False if the queue already has it, so two callers cannot enqueue it twice.
    """
    return _enqueue(connection, job_id, rq_id(job_id, generation), result_ttl=KEEP_FINISHED)


def _enqueue(
    connection: redis.Redis, job_id: str, entry: str, result_ttl: int, failure_ttl: int | None = None
) -> bool:
    """result_ttl, failure_ttl: seconds for which RQ keeps the record of an entry that has ended."""
    try:
        open_queue(connection).enqueue_call(
            ATTEMPT,
            args=[job_id],
            job_id=entry,
            timeout=JOB_TIMEOUT,
            result_ttl=result_ttl,
            failure_ttl=failure_ttl,
            retry=Retry(max=MAX_RETRIES),
            description=f"entry {entry} of job {job_id}",
            unique=True,
        )
    except DuplicateJobError:
        return False
    # A crash here leaves the entry where it arrived; the next worker that looks for one sorts it.
    lines.sort(connection)
    return True


def offer_tile(connection: redis.Redis, job_id: str, generation: int, tile: int) -> bool:
    """Let any worker take a tile of a scene: append it to the line of its job. Return False if the queue has it."""
    entry = unit_id(job_id, generation, tile)
    return _enqueue(connection, job_id, entry, result_ttl=KEEP_TILES, failure_ttl=KEEP_TILES)


def take_back_tile(connection: redis.Redis, job_id: str, generation: int, tile: int) -> bool:
    """Take a tile out of the queue. Return False if a worker has it; then that has ended, or its lease will expire."""
    entry = unit_id(job_id, generation, tile)
    if lines.withdraw(connection, entry, keep=0):
        return True
    record = _record(connection, entry)
    if record is None or _STATES.get(record.get_status(refresh=False)) in ("finished", "failed", "stopped"):
        return True
    # Redis may have lost the lease and not the record.
    return leases.drop_unheld(connection, entry)


def withdraw_tiles(connection: redis.Redis, job_id: str, generation: int, tiles: int | None) -> None:
    """Remove the waiting tiles of a generation from the queue. tiles: of its scene; None for a scene in one piece."""
    for tile in range(1, UNITS_PER_TILE * (tiles or 0) + 1):
        lines.withdraw(connection, unit_id(job_id, generation, tile), keep=0)


def status(connection: redis.Redis, job_id: str, generation: int) -> QueueStatus:
    """Return what the queue knows about a generation."""
    job = _record(connection, rq_id(job_id, generation))
    if job is None:
        return QueueStatus("absent")
    state = _STATES.get(job.get_status(refresh=False), "waiting")
    if state == "failed":
        result = job.latest_result()
        return QueueStatus(state, reason=_last_line(result.exc_string if result else None))
    return QueueStatus(state, worker=job.worker_name or None)


def states(connection: redis.Redis, generations: Sequence[tuple[str, int]]) -> list[QueueState]:
    """Return the states in the queue of these jobs and generations, in one round trip."""
    with connection.pipeline(transaction=False) as pipe:
        for job_id, generation in generations:
            pipe.hget(QueueEntry.key_for(rq_id(job_id, generation)), "status")
        replies = pipe.execute()
    known = {status.value.encode(): state for status, state in _STATES.items()}
    return ["absent" if reply is None else known.get(reply, "waiting") for reply in replies]


def withdraw(connection: redis.Redis, job_id: str, generation: int) -> bool:
    """Remove a waiting generation from the queue. Return True if it was there; then no process will run it."""
    return lines.withdraw(connection, rq_id(job_id, generation))


def stop(connection: redis.Redis, job_id: str, generation: int) -> bool:
    """Ask the worker that runs this generation to kill it; return False if no worker is known to run it.

    Repeat the call until `status` is `stopped`: the message is sent by publish and subscribe and may be lost.
    """
    try:
        send_stop_job_command(connection, rq_id(job_id, generation), serializer=SERIALIZER)
    except (NoSuchJobError, InvalidJobOperation):
        return False
    return True


def forget(connection: redis.Redis, job_id: str, generation: int) -> None:
    """Delete RQ's record of a generation that has ended."""
    lines.withdraw(connection, rq_id(job_id, generation))
    job = _record(connection, rq_id(job_id, generation))
    if job is not None:
        job.delete()


def _record(connection: redis.Redis, entry: str) -> Job | None:
    try:
        return QueueEntry.fetch(entry, connection=connection, serializer=SERIALIZER)
    except NoSuchJobError:
        return None


def _last_line(trace: str | None) -> str | None:
    lines = [line for line in (trace or "").strip().splitlines() if line.strip()]
    return lines[-1].strip() if lines else None
