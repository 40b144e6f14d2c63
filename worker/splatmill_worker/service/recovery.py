"""What a starting worker does about workers that died: their attempts go back to the queue at once.

RQ would wait for the heartbeat to expire and spend one of the job's tries. A worker signs its record with its
process, so that its successor on the same machine can prove that it is dead.
"""

import json
import os
import signal
from contextlib import suppress
from typing import Any, cast

import redis
from rq import Queue, Worker
from rq.executions import Execution
from rq.job import Job
from rq.worker_registration import get_keys

from splatmill.backplane import keys
from splatmill.backplane.process import ProcessIdentity, wait_gone
from splatmill.backplane.queue import QueueEntry, split_rq_id
from splatmill_worker.service import attempt
from splatmill_worker.service.attempt import Attempt
from splatmill_worker.service.lock import Holder, JobLock

_IDENTITY = "splatmill_process"
_DYING_SECONDS = 5.0


def sign(worker: Worker) -> None:
    """Write into a worker's record which process it is."""
    worker.connection.hset(worker.key, _IDENTITY, json.dumps(ProcessIdentity.of(os.getpid()).dump()))


def hand_back(worker: Worker, job: Job, queue: Queue) -> None:
    """Put an interrupted job at the head of its queue without spending one of its tries."""
    with worker.connection.pipeline() as pipeline:
        worker.cleanup_execution(job, pipeline=pipeline)
        # The public enqueue_job begins a transaction of its own, which this one would not hold.
        queue._enqueue_job(job, pipeline=pipeline, at_front=True)
        pipeline.execute()


def attempts(worker: Worker, job_id: str) -> int:
    """How many attempts at a job have begun."""
    return int(cast(Any, worker.connection.get(keys.attempts(job_id))) or 0)


def adopt(worker: Worker) -> None:
    """Requeue what dead workers were doing, and strike them off the list."""
    queue = worker.queues[0]
    others = [key for key in get_keys(queue) if key != worker.key]
    dead = {key for key in others if _dead(worker.connection, key)}
    for rq_job_id, execution_id in queue.started_job_registry.get_job_and_execution_ids(cleanup=False):
        _adopt_started(worker, queue, rq_job_id, execution_id)
    if set(others) == dead:
        # A worker may have died between taking a job and registering it; no living one can be doing so now.
        for rq_job_id in queue.intermediate_queue.get_job_ids():
            if worker.connection.lrem(queue.intermediate_queue_key, 1, rq_job_id):
                queue.push_job_id(rq_job_id, at_front=True)
    for key in dead:
        with worker.connection.pipeline() as pipeline:
            pipeline.srem(worker.redis_workers_keys, key)
            pipeline.srem(f"rq:workers:{queue.name}", key)
            pipeline.delete(key)
            pipeline.execute()


def _dead(connection: redis.Redis, worker_key: str) -> bool:
    """Whether a registered worker is dead for certain, or so long gone that its record expired."""
    signed = cast(bytes | None, connection.hget(worker_key, _IDENTITY))
    if signed is None:
        return not connection.exists(worker_key)
    return ProcessIdentity.load(json.loads(signed)).dead()


def _adopt_started(worker: Worker, queue: Queue, rq_job_id: str, execution_id: str) -> None:
    connection = worker.connection
    job_id, generation = split_rq_id(rq_job_id)
    lock = JobLock(connection, job_id, token="")
    holder = lock.holder()
    try:
        owner = Execution.fetch(execution_id, rq_job_id, connection).worker_name
        orphaned = _dead(connection, worker.redis_worker_namespace_prefix + owner)
    except ValueError:
        # The execution's record expired; the lock's does not, and names the process.
        orphaned = holder is not None and holder.process.visible() and holder.process.dead()
    if not orphaned or not (holder is None or _ended(holder)):
        return
    registry = queue.started_job_registry
    if not connection.zrem(registry.key, f"{rq_job_id}:{execution_id}"):
        return  # another worker, or the server's clean-up, was faster
    if not QueueEntry.exists(rq_job_id, connection):
        return
    job = QueueEntry.fetch(rq_job_id, connection=connection, serializer=worker.serializer)
    number = holder.attempt if holder else 0
    told = Attempt(connection, job_id, generation, number or attempts(worker, job_id), lock)
    attempt.requeued(told, "The worker ended in the middle of the job; the job goes back to the queue.")
    queue.enqueue_job(job, at_front=True)


def _ended(holder: Holder) -> bool:
    """Whether an attempt's process is gone; one whose parent is dead is given a moment, and the last push."""
    process = holder.process
    if not process.visible():
        return holder.gone()
    if not process.dead():
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
    return wait_gone(process.pid, process.started, _DYING_SECONDS)
