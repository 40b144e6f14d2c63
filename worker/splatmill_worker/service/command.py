"""Starts the queue worker: `python -m splatmill_worker train`."""

import importlib
import logging
import os
import sys
import time
from typing import cast

import redis

from splatmill.backplane import keys, log_lines
from splatmill.backplane.connection import connect
from splatmill.backplane.private_files import exposure
from splatmill.backplane.redact import redacted
from splatmill.garbage import uncollected
from splatmill_worker import settings
from splatmill_worker.service.attempt_limits import Limits
from splatmill_worker.service.attempts.run_attempt import Pipeline
from splatmill_worker.service.rq_worker import STOP_GRACE, AttemptWorker
from splatmill_worker.service.served_lines import served_lines

REDIS_WAIT = 60.0
"""Seconds that a starting worker waits for Redis, which may be starting at the same time."""


def serve(stop_grace: float | None, queues: str | None = None) -> int:
    """Take jobs from the queue until a signal to stop. Return the exit status.

    stop_grace: seconds that an attempt has to save its state on such a signal; None means STOP_GRACE.
    queues: the queues to serve, separated by commas; None means SPLATMILL_QUEUES, or all that this machine can run.
    """
    url = settings.redis_url()
    try:
        log_lines.configure(settings.log_format())
        os.umask(settings.umask())
        settings.disk_reserve()
        connection = connect(url)
        served = served_lines(queues or settings.queues())
        limits = Limits.from_settings()
        settings.max_unpacked()
        settings.keep_work()  # a wrong value is better found here than in the first maintenance
    except ValueError as error:
        print(error, file=sys.stderr)
        return 1
    if (exposed := exposure(settings.data_folder(), settings.umask())) is not None:
        logging.getLogger("splatmill.worker").warning("%s", exposed)
    deadline = time.monotonic() + REDIS_WAIT
    while True:
        try:
            connection.set(keys.WRITABLE, 1, ex=int(REDIS_WAIT))
            break
        except redis.RedisError as error:
            if time.monotonic() > deadline:
                refuses = isinstance(error, redis.ResponseError)
                print(
                    f"Redis at {redacted(url)} {'refuses writes' if refuses else 'could not be reached'} for "
                    f"{REDIS_WAIT:g} s: {error}. "
                    + (
                        "Free its disk or memory, or change its settings."
                        if refuses
                        else "Start it there, or set REDIS_URL to the address of a running one."
                    ),
                    file=sys.stderr,
                )
                return 1
            time.sleep(0.05)
    grace = STOP_GRACE if stop_grace is None else stop_grace
    AttemptWorker(connection, _pipeline, served, grace, limits).work()
    return 0


def _pipeline() -> Pipeline:
    """Import what attempts run. What it imports stays, and is never garbage."""
    with uncollected():
        return cast(Pipeline, importlib.import_module(settings.pipeline()).run)
