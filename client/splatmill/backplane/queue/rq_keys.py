"""The keys of RQ in Redis that Splatmill reads or writes. No other module names one.

RQ's own names are used where it exports them.
"""

from rq.job import Job
from rq.queue import Queue
from rq.registry import StartedJobRegistry
from rq.worker_registration import REDIS_WORKER_KEYS, WORKERS_BY_QUEUE_KEY

from splatmill.backplane.queue.entries import TRAIN

RECORD = Job.redis_job_namespace_prefix
"""What the key of an entry's record begins with: a hash with its status and the name of its worker. The id follows."""

EXECUTION = "rq:execution:"
"""What the key of an execution's record begins with, a hash; `<entry>:<execution>` follows."""

ARRIVALS = Queue.redis_queue_namespace_prefix + TRAIN
"""List of the entries that have arrived and are in no line yet."""

STARTED = StartedJobRegistry.key_template.format(TRAIN)
"""Sorted set of the leases: `<entry>:<execution>`, scored by the time at which the lease expires."""

WORKERS = REDIS_WORKER_KEYS
"""Set of the keys of all workers' records."""

LISTENING = WORKERS_BY_QUEUE_KEY % TRAIN
"""Set of the keys of the records of the workers that serve the queue."""


def record(entry: str) -> str:
    """Return the key of the record of an entry."""
    return RECORD + entry


def execution(member: str) -> str:
    """Return the key of the record of an execution. member: `<entry>:<execution>`."""
    return EXECUTION + member
