"""Proves what a worker that starts, or looks after the queue, asks of Redis beside many others.

Does not prove that what a dead worker held runs again: test_rq_worker and tests/service do.
"""

from typing import Any

import pytest
import redis
from _capacity.operations import counted

from splatmill.backplane import keys
from splatmill.backplane.queue import leases, lines, queue, workers
from splatmill_worker.service import recovery
from splatmill_worker.service.command import _pipeline
from splatmill_worker.service.rq_worker import AttemptWorker
from tests.support.jobs import write_row
from tests.support.servers.queue_entries import take, waiting


def registered(connection: redis.Redis, name: str, **fields: str) -> None:
    """Register a worker of this process, as the worker does, with other fields where they are given."""
    key = f"rq:worker:{name}"
    record: Any = {"state": "busy"} | workers.served(["any"]) | recovery.process_fields() | fields
    connection.hset(key, mapping=record)
    connection.sadd("rq:workers", key)
    connection.sadd("rq:workers:train", key)


def running(connection: redis.Redis, number: int) -> None:
    """Register a worker, and let it hold a job."""
    registered(connection, f"worker{number}")
    write_row(connection, f"job{number:05}")
    queue.enqueue(connection, f"job{number:05}", 1)
    take(connection, worker=f"worker{number}")


def test_a_start_takes_the_same_round_trips_beside_many_workers_as_beside_few(
    connection: redis.Redis, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lines, "LEASE", 3600)  # no lease expires meanwhile, on a machine however busy
    counts = []
    for numbers in (range(2), range(2, 40)):
        for number in numbers:
            running(connection, number)
        this = AttemptWorker(connection, _pipeline)
        with counted() as operations:
            recovery.requeue_orphans(this)
        counts.append(operations.round_trips)
    assert counts[0] == counts[1]
    assert len(leases.held(connection)) == 40, "all of them live"


def test_only_what_the_dead_held_is_requeued(connection: redis.Redis) -> None:
    for number in range(3):
        running(connection, number)
    connection.delete("rq:worker:worker1")  # silent until its record expired
    recovery.requeue_orphans(AttemptWorker(connection, _pipeline))
    assert waiting(connection) == 1
    assert {lease.entry for lease in leases.held(connection)} == {"job00000-1", "job00002-1"}
    assert connection.smembers("rq:workers") == {b"rq:worker:worker0", b"rq:worker:worker2"}


def test_one_worker_cleans_the_lists_for_all(connection: redis.Redis) -> None:
    first, second = AttemptWorker(connection, _pipeline), AttemptWorker(connection, _pipeline)
    first.clean_registries()
    connection.sadd("rq:workers:train", "rq:worker:ghost")
    second.clean_registries()
    assert connection.sismember("rq:workers:train", "rq:worker:ghost"), "it was cleaned a moment ago"
    connection.delete(keys.REGISTRIES_CHECKED)
    second.clean_registries()
    assert not connection.sismember("rq:workers:train", "rq:worker:ghost")
