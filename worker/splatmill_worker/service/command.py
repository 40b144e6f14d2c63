"""Starts the queue worker: `python -m splatmill_worker train`.

The imports of this process are those of every attempt that it forks: nothing with threads of its own.
"""

import sys
import time

import redis

from splatmill.backplane.connection import connect
from splatmill_worker import settings
from splatmill_worker.service.rq_worker import STOP_GRACE, AttemptWorker

REDIS_PATIENCE = 60.0
"""Seconds a starting worker waits for Redis, which may be starting beside it."""


def serve(stop_grace: float | None) -> int:
    """Take jobs from the queue until told to stop; returns the exit status.

    stop_grace: seconds an attempt has to save its state when the worker is told to stop; None means STOP_GRACE.
    """
    url = settings.redis_url()
    connection = connect(url)
    deadline = time.monotonic() + REDIS_PATIENCE
    while True:
        try:
            connection.ping()
            break
        except redis.exceptions.ConnectionError as error:
            if time.monotonic() > deadline:
                print(
                    f"Redis cannot be reached at {url}: {error}. Start it, or set REDIS_URL.", file=sys.stderr
                )
                return 1
            time.sleep(0.05)
    AttemptWorker(connection, stop_grace=STOP_GRACE if stop_grace is None else stop_grace).work()
    return 0
