"""The queue between server and worker: RQ, with every setting that must differ from its defaults in one place.

An RQ job is one generation of one Splatmill job; each try at it is an attempt. The server enqueues and stops by
the dotted name of the function, so it never imports the worker.
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
"""The queue of workers that take a job from photos to model. One queue per worker kind: listening on several
opens a small window in which RQ loses a job."""

QUEUES = (TRAIN,)

ATTEMPT = "splatmill_worker.service.job.run_attempt"
"""What a worker calls, with the job id as its one argument; the generation is in the RQ job's id."""

SERIALIZER = JSONSerializer
"""JSON, not RQ's default pickle: whoever can write to Redis must not thereby run code in a worker."""

JOB_TIMEOUT = -1
"""No time limit (RQ's default is 180 s); a job's own `time_budget` ends its training."""

MAX_RETRIES = 3
"""Tries after the first when a process dies; a failure the pipeline reports itself is not tried again."""

WORKER_TTL = 30
"""Seconds until an idle worker that went away is forgotten (RQ's default is 420)."""

MAINTENANCE_INTERVAL = 10
"""Seconds between an idle worker's clean-ups (RQ's default is 600)."""

MONITORING_INTERVAL = 5
"""Seconds between heartbeats of a busy worker's parent process (RQ's default is 30)."""

HEARTBEAT_SLACK = 10
"""Seconds a heartbeat may be late before the attempt counts as lost (RQ builds in 60). With the interval above,
a job whose machine died is taken up again after 15 s plus one reaper tick."""

KEEP_FINISHED = 24 * 3600
"""Seconds RQ keeps its own record of a finished job; Splatmill's record stays until the job is deleted."""

Standing = Literal["waiting", "running", "finished", "failed", "stopped", "absent"]
"""What the queue knows of a generation: `failed` means its tries are used up, `stopped` that it was killed on
request or taken out of the queue and no process of it is left, `absent` that RQ has no record."""

_OUR_LOCK = 30
_RQ_LOCK = 899
"""Seconds after which our lock on cleaning a queue, and RQ's own, expire."""

_STANDINGS: dict[JobStatus, Standing] = {
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
class Place:
    """Where a generation stands in the queue: `position` counts from 0 while waiting; `reason` is RQ's last word
    on a failed one; `worker` names the one that runs it."""

    standing: Standing
    position: int | None = None
    worker: str | None = None
    reason: str | None = None


def open_queue(connection: redis.Redis, name: str = TRAIN) -> Queue:
    """The RQ queue with our serializer and no time limit."""
    return Queue(name, connection=connection, serializer=SERIALIZER, default_timeout=JOB_TIMEOUT)


def rq_id(job_id: str, generation: int) -> str:
    """RQ's id of one generation of a job. RQ allows letters, digits, `_` and `-` only."""
    return f"{job_id}-{generation}"


def split_rq_id(text: str) -> tuple[str, int]:
    """The job id and generation in RQ's id; ValueError when it is not one of ours."""
    job_id, _, generation = text.rpartition("-")
    if not job_id or not generation.isdigit():
        raise ValueError(f"{text!r} is not '<job id>-<generation>'.")
    return job_id, int(generation)


def enqueue(connection: redis.Redis, job_id: str, generation: int, name: str = TRAIN) -> bool:
    """Put a generation at the end of the queue; False when RQ already has it, so two callers cannot double it."""
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


def place(connection: redis.Redis, job_id: str, generation: int) -> Place:
    """Where a generation stands now."""
    job = _fetch(connection, job_id, generation)
    if job is None:
        return Place("absent")
    standing = _STANDINGS.get(job.get_status(refresh=False), "waiting")
    if standing == "waiting":
        return Place(standing, position=open_queue(connection, job.origin).get_job_position(job))
    if standing == "failed":
        result = job.latest_result()
        return Place(standing, reason=_last_line(result.exc_string if result else None))
    return Place(standing, worker=job.worker_name or None)


def withdraw(connection: redis.Redis, job_id: str, generation: int) -> bool:
    """Take a waiting generation out of the queue. True means it was there and no process will ever run it."""
    job = _fetch(connection, job_id, generation)
    if job is None:
        return False
    queue = open_queue(connection, job.origin)
    # LREM decides the race with a worker that is just taking the job: only one of the two gets it.
    removed = connection.lrem(queue.key, 1, job.id)
    if removed:
        job.cancel()
    return bool(removed)


def stop(connection: redis.Redis, job_id: str, generation: int) -> bool:
    """Ask the worker that runs this generation to kill it. Repeat until `place` says `stopped`: the message goes by
    publish and subscribe, which forgets. False when no worker is known to run it now."""
    try:
        send_stop_job_command(connection, rq_id(job_id, generation), serializer=SERIALIZER)
    except (NoSuchJobError, InvalidJobOperation):
        return False
    return True


def forget(connection: redis.Redis, job_id: str, generation: int) -> None:
    """Remove RQ's record of a generation that is over."""
    job = _fetch(connection, job_id, generation)
    if job is not None:
        job.delete()


def reclaim(connection: redis.Redis) -> None:
    """Requeue attempts whose worker stopped giving heartbeats, and fail those without tries left.

    A busy worker never does this for a crashed neighbour; the API process calls it every few seconds.
    """
    for name in QUEUES:
        queue = open_queue(connection, name)
        # The lock that idle workers clean under: two cleaners at once would requeue an attempt twice.
        if connection.set(queue.registry_cleaning_key, 1, nx=True, ex=_OUR_LOCK):
            try:
                queue.started_job_registry.cleanup()
            finally:
                connection.delete(queue.registry_cleaning_key)
        elif _OUR_LOCK < connection.ttl(queue.registry_cleaning_key) < _RQ_LOCK - _OUR_LOCK:
            # Held for longer than any cleaning takes: its worker was killed while it cleaned.
            connection.delete(queue.registry_cleaning_key)


def waiting(connection: redis.Redis) -> dict[str, int]:
    """How many generations wait in each queue."""
    return {name: open_queue(connection, name).count for name in QUEUES}


def _fetch(connection: redis.Redis, job_id: str, generation: int) -> Job | None:
    try:
        return Job.fetch(rq_id(job_id, generation), connection=connection, serializer=SERIALIZER)
    except NoSuchJobError:
        return None


def _last_line(trace: str | None) -> str | None:
    lines = [line for line in (trace or "").strip().splitlines() if line.strip()]
    return lines[-1].strip() if lines else None
