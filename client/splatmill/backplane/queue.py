"""The job queue between server and worker: RQ, and all settings that differ from its defaults.

An RQ job is one generation of a Splatmill job, and each run of it is an attempt. The server does not import the worker:
which function runs an attempt is decided there.
"""

from dataclasses import dataclass
from typing import Literal

import redis
from rq import Queue, Retry
from rq.command import send_stop_job_command
from rq.exceptions import DuplicateJobError, InvalidJobOperation, NoSuchJobError
from rq.job import Job, JobStatus
from rq.serializers import JSONSerializer

TRAIN = "train"
"""The queue of training jobs. A worker listens on one queue: with several, RQ can lose a job while it is dequeued."""

QUEUES = (TRAIN,)

ATTEMPT = "splatmill_worker.job.run_attempt"
"""The function name that each entry carries, because RQ requires one, with the job id as its argument. A worker runs
its own attempt function whatever the name says. The name stays for workers of earlier versions, which import it."""

SERIALIZER = JSONSerializer
"""JSON in place of pickle, RQ's default, so that write access to Redis does not allow running code in a worker.
`QueueEntry` serves the same end."""

JOB_TIMEOUT = -1
"""No time limit (RQ's default is 180 s); the option `time_budget` limits the training."""

MAX_RETRIES = 3
"""Number of further attempts when the process of a job dies. A failure that the pipeline reports is not retried."""

WORKER_TTL = 30
"""Seconds after which an idle worker that has disappeared is no longer listed (RQ's default is 420)."""

MAINTENANCE_INTERVAL = 10
"""Seconds between two looks of an idle worker for expired leases (RQ's default is 600)."""

MONITORING_INTERVAL = 5
"""Seconds between the heartbeats of a busy worker, each of which prolongs its lease (RQ's default is 30)."""

HEARTBEAT_SLACK = 10
"""Seconds by which a heartbeat may be late before the attempt counts as lost (RQ's constant is 60). If a machine
dies, its job is requeued when its lease has expired (see `leases`), after at most one more interval of the reaper."""

KEEP_FINISHED = 24 * 3600
"""Seconds for which RQ keeps its record of a finished job. Splatmill's own stays until the job is deleted."""

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
    position: number of jobs before it while it waits.
    worker: name of the worker that runs it.
    reason: last line of RQ's error message if it failed.
    """

    state: QueueState
    position: int | None = None
    worker: str | None = None
    reason: str | None = None


class QueueEntry(Job):
    """RQ's record of one generation of a job, without callbacks, which RQ would import by names found in Redis."""

    success_callback = None
    failure_callback = None
    stopped_callback = None


def open_queue(connection: redis.Redis, name: str = TRAIN) -> Queue:
    """Return the RQ queue with this name, with JSON as serializer, `QueueEntry` as job class and no time limit."""
    return Queue(
        name,
        connection=connection,
        serializer=SERIALIZER,
        job_class=QueueEntry,
        default_timeout=JOB_TIMEOUT,
    )


def rq_id(job_id: str, generation: int) -> str:
    """Return RQ's id of a generation of a job. RQ allows only letters, digits, `_` and `-`."""
    return f"{job_id}-{generation}"


def split_rq_id(text: str) -> tuple[str, int]:
    """Return the job id and the generation in an id of RQ. Raises ValueError for an id of another form."""
    job_id, _, generation = text.rpartition("-")
    if not job_id or not generation.isdigit():
        raise ValueError(f"{text!r} is not '<job id>-<generation>'.")
    return job_id, int(generation)


def enqueue(connection: redis.Redis, job_id: str, generation: int, name: str = TRAIN) -> bool:
    """Append a generation to the queue; return False if RQ already has it, so two callers cannot enqueue it twice."""
    try:
        open_queue(connection, name).enqueue_call(
            ATTEMPT,
            args=[job_id],
            job_id=rq_id(job_id, generation),
            timeout=JOB_TIMEOUT,
            result_ttl=KEEP_FINISHED,
            retry=Retry(max=MAX_RETRIES),
            description=f"job {job_id}, generation {generation}",
            unique=True,
        )
    except DuplicateJobError:
        return False
    return True


def status(connection: redis.Redis, job_id: str, generation: int) -> QueueStatus:
    """Return what the queue knows about a generation."""
    job = _fetch(connection, job_id, generation)
    if job is None:
        return QueueStatus("absent")
    state = _STATES.get(job.get_status(refresh=False), "waiting")
    if state == "waiting":
        return QueueStatus(state, position=open_queue(connection, job.origin).get_job_position(job))
    if state == "failed":
        result = job.latest_result()
        return QueueStatus(state, reason=_last_line(result.exc_string if result else None))
    return QueueStatus(state, worker=job.worker_name or None)


def withdraw(connection: redis.Redis, job_id: str, generation: int) -> bool:
    """Remove a waiting generation from the queue. Return True if it was there; then no process will run it."""
    job = _fetch(connection, job_id, generation)
    if job is None:
        return False
    queue = open_queue(connection, job.origin)
    # LREM is atomic: of this call and a worker that dequeues the job at the same time, only one gets it.
    removed = connection.lrem(queue.key, 1, job.id)
    if removed:
        job.cancel()
    return bool(removed)


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
    job = _fetch(connection, job_id, generation)
    if job is not None:
        job.delete()


def waiting(connection: redis.Redis) -> dict[str, int]:
    """Return the number of waiting generations by queue."""
    return {name: open_queue(connection, name).count for name in QUEUES}


def _fetch(connection: redis.Redis, job_id: str, generation: int) -> Job | None:
    try:
        return QueueEntry.fetch(rq_id(job_id, generation), connection=connection, serializer=SERIALIZER)
    except NoSuchJobError:
        return None


def _last_line(trace: str | None) -> str | None:
    lines = [line for line in (trace or "").strip().splitlines() if line.strip()]
    return lines[-1].strip() if lines else None
