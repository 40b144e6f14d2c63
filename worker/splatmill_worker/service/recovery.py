"""Puts attempts of dead workers back into the queue when a worker starts.

RQ would wait until their heartbeats expire, and count the attempt as a failed one. A worker stores its process in its
record, so that another one on the same machine can tell that it is dead.
"""

import json
import os
import signal
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, cast

import redis
from rq import Worker
from rq.executions import Execution
from rq.worker_registration import get_keys

from splatmill.backplane import keys
from splatmill.backplane.queue import leases, lines, rq_keys
from splatmill.backplane.queue.entries import split_rq_id, tile_of
from splatmill.backplane.queue.leases import Lease
from splatmill.process import ProcessIdentity, wait_gone
from splatmill_worker.service.attempts.attempt import Attempt
from splatmill_worker.service.lock import Holder, JobLock

_PROCESS_FIELD = "splatmill_process"
_KILL_SECONDS = 5.0


def process_fields() -> dict[str, str]:
    """Return the fields of a worker's record with the identity of this process."""
    return {_PROCESS_FIELD: json.dumps(ProcessIdentity.of(os.getpid()).dump())}


def is_recorded(worker: Worker) -> bool:
    """Return whether the worker's record is there and listed.

    The record expires while Redis cannot be reached; another worker that cleans the list then takes it off.
    """
    with worker.connection.pipeline(transaction=False) as pipe:
        pipe.hexists(worker.key, _PROCESS_FIELD)
        pipe.sismember(rq_keys.WORKERS, worker.key)
        return all(pipe.execute())


def hand_back(worker: Worker, lease: Lease) -> None:
    """Put an interrupted entry in front of its owner's line, without using up one of its retries."""
    lines.hand_back(worker.connection, lease)
    worker.set_current_job_id(None)
    worker.execution = None


def ended_attempt(connection: redis.Redis, entry_id: str, lock: JobLock, holder: Holder | None) -> Attempt:
    """Return the attempt that has just ended, to report in its name.

    holder: the holder of the lock if that is the attempt. Without it, or if it ended before it was counted, the newest
    attempt at the job is meant.
    """
    job_id, generation = split_rq_id(entry_id)
    number = holder.attempt if holder else 0
    newest = int(cast(Any, connection.get(keys.attempts(job_id))) or 0)
    return Attempt(connection, job_id, generation, number or newest, lock)


def requeue_orphans(worker: Worker) -> None:
    """Requeue the entries of dead workers, and delete the records of these workers."""
    queue = worker.queues[0]
    others = [key for key in get_keys(queue) if key != worker.key]
    dead = set(_dead_workers(worker.connection, others))
    living_names = {
        key.removeprefix(worker.redis_worker_namespace_prefix) for key in others if key not in dead
    }
    held = leases.held(worker.connection)
    for lease, owner in zip(held, leases.owners(worker.connection, held), strict=True):
        if owner not in living_names:
            _requeue_if_orphaned(worker, lease)
    for key in dead:
        with worker.connection.pipeline() as pipeline:
            pipeline.srem(worker.redis_workers_keys, key)
            pipeline.srem(rq_keys.LISTENING, key)
            pipeline.delete(key)
            pipeline.execute()


def _dead_workers(connection: redis.Redis, worker_keys: Sequence[str]) -> list[str]:
    """Return those of the registered workers that are certainly dead, or silent until their records expired.

    It takes two round trips, because a worker that starts reads all others.
    """
    with connection.pipeline(transaction=False) as pipe:
        for key in worker_keys:
            pipe.hget(key, _PROCESS_FIELD)
        recorded = cast(list[bytes | None], pipe.execute())
        silent = [key for key, process in zip(worker_keys, recorded, strict=True) if process is None]
        for key in silent:
            pipe.exists(key)
        gone = [key for key, there in zip(silent, pipe.execute(), strict=True) if not there]
    ended = {
        process: ProcessIdentity.load(json.loads(process)).dead()
        for process in set(recorded)
        if process is not None
    }
    return gone + [
        key
        for key, process in zip(worker_keys, recorded, strict=True)
        if process is not None and ended[process]
    ]


def _requeue_if_orphaned(worker: Worker, lease: Lease) -> None:
    connection = worker.connection
    job_id, _ = split_rq_id(lease.entry)
    lock = JobLock(connection, job_id, token="")
    is_tile = tile_of(lease.entry) is not None
    holder = None if is_tile else lock.holder()  # a worker that does a tile has no lock on the job
    try:
        owner = Execution.fetch(lease.execution, lease.entry, connection).worker_name
        orphaned = bool(_dead_workers(connection, [worker.redis_worker_namespace_prefix + owner]))
    except ValueError:
        # The record of the execution has expired. The lock has not, and it names the process.
        orphaned = holder is not None and holder.process.visible() and holder.process.dead()
    if not orphaned or not (holder is None or _has_ended(holder)):
        return
    ended = ended_attempt(connection, lease.entry, lock, holder)
    if leases.requeue(connection, lease, if_expired=False) == "waiting" and not is_tile:
        ended.report_requeued("The worker ended during this attempt. The job was put back into the queue.")


def _has_ended(holder: Holder) -> bool:
    """Return whether the process of an attempt whose worker is dead has ended. On this machine, kill it first."""
    process = holder.process
    if not process.visible():
        return holder.gone()
    if not process.dead():
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
    return wait_gone(process.pid, process.started, _KILL_SECONDS)
