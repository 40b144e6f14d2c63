"""A worker of RQ alone, and the work that its entries do: python _rq_worker.py ADDRESS QUEUE..."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import redis
from rq import Queue
from rq.serializers import JSONSerializer
from rq.worker import RoundRobinWorker

HEARTBEAT = 5
"""Seconds between heartbeats of a busy worker, as Splatmill has it; RQ's own is 30."""

MAINTENANCE = 10
"""Seconds between two searches for entries of lost workers, as Splatmill has it; RQ's own is 600."""


PAUSE = 0.2
"""Seconds between two lines of the work."""


def work(path: str, seconds: float) -> None:
    """Write a line with the process and the time to a file, five times a second; the last one says `end`."""
    for _ in range(round(seconds / PAUSE)):
        _write(path, "at")
        time.sleep(PAUSE)
    _write(path, "end")


def _write(path: str, word: str) -> None:
    with Path(path).open("a") as file:
        file.write(f"{os.getpid()} {time.time():.3f} {word}\n")


class DiesBeforeItBegins(RoundRobinWorker):
    """Ends as if it were killed, once it has taken an entry and before that has begun."""

    def execute_job(self, job: object, queue: object) -> None:
        os._exit(9)


def main() -> None:
    address, kind, *names = sys.argv[1:]
    connection = redis.Redis.from_url(address)
    queues = [Queue(name, connection=connection, serializer=JSONSerializer) for name in names]
    worker = (DiesBeforeItBegins if kind == "dies" else RoundRobinWorker)(
        queues,
        connection=connection,
        serializer=JSONSerializer,
        worker_ttl=30,
        job_monitoring_interval=HEARTBEAT,
        maintenance_interval=MAINTENANCE,
    )
    worker.work(logging_level="CRITICAL")


if __name__ == "__main__":
    main()
