"""Starts the queue worker: `python -m splatmill_worker train`."""

import sys
import time

import redis

from splatmill.backplane.connection import InvalidRedisUrl, connect
from splatmill.backplane.redact import redacted
from splatmill_worker import settings
from splatmill_worker.service.rq_worker import STOP_GRACE, AttemptWorker

REDIS_WAIT = 60.0
"""Seconds that a starting worker waits for Redis, which may be starting at the same time."""


def serve(stop_grace: float | None) -> int:
    """Take jobs from the queue until a signal to stop. Return the exit status.

    stop_grace: seconds that an attempt has to save its state on such a signal; None means STOP_GRACE.
    """
    url = settings.redis_url()
    try:
        connection = connect(url)
    except InvalidRedisUrl as error:
        print(error, file=sys.stderr)
        return 1
    deadline = time.monotonic() + REDIS_WAIT
    while True:
        try:
            connection.ping()
            break
        except redis.exceptions.ConnectionError as error:
            if time.monotonic() > deadline:
                print(
                    f"Redis could not be reached at {redacted(url)} within {REDIS_WAIT:g} s: {error}. "
                    "Start it there, or set REDIS_URL to the address of a running one.",
                    file=sys.stderr,
                )
                return 1
            time.sleep(0.05)
    AttemptWorker(connection, stop_grace=STOP_GRACE if stop_grace is None else stop_grace).work()
    return 0
