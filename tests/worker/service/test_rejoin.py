"""Proves that a lease is taken again from a Redis that has lost its data, and from no worker and no line.

Does not prove that a running attempt continues: tests/service/test_kills does.
"""

from typing import Any

import redis

from splatmill.backplane.queue import entries, leases, lines, queue, rq_keys
from tests.support.jobs import write_row
from tests.support.servers.queue_entries import take, waiting

JOB, ENTRY = "job00001", "job00001-1"


def taken(connection: redis.Redis) -> tuple[leases.Lease, dict[str, Any]]:
    """A lease on the entry of a job, and RQ's record of it as its worker knows it."""
    write_row(connection, JOB)
    queue.enqueue(connection, JOB, 1)
    lease = take(connection)
    job = entries.QueueEntry.fetch(ENTRY, connection=connection, serializer=entries.SERIALIZER)
    return lease, job.to_dict(include_meta=False)


def test_an_empty_redis_has_the_lease_and_the_record_again(connection: redis.Redis) -> None:
    lease, record = taken(connection)
    connection.flushall()
    assert not leases.prolong(connection, lease)
    assert leases.rejoin(connection, lease, "tester", record)
    assert leases.prolong(connection, lease)
    assert leases.held(connection) == [lease]
    assert leases.running(connection) == {"tester": 0.0}
    assert queue.status(connection, JOB, 1) == queue.QueueStatus("running", worker="tester")
    again = entries.QueueEntry.fetch(ENTRY, connection=connection, serializer=entries.SERIALIZER)
    assert again.retries_left == record["retries_left"]
    write_row(connection, JOB)
    assert lines.hand_back(connection, lease)
    assert waiting(connection) == 1


def test_a_lease_that_another_worker_has_is_not_taken_again(connection: redis.Redis) -> None:
    lease, record = taken(connection)
    assert leases.requeue(connection, lease, if_expired=False) == "waiting"
    assert not leases.rejoin(connection, lease, "tester", record), "it waits to be sorted"
    assert waiting(connection) == 1
    assert not leases.rejoin(connection, lease, "tester", record), "it waits in its line"
    other = take(connection, worker="other")
    assert not leases.rejoin(connection, lease, "tester", record)
    connection.hset(f"rq:job:{ENTRY}", "worker_name", "tester")  # RQ writes this when an attempt begins late
    assert not leases.rejoin(connection, lease, "tester", record)
    assert leases.held(connection) == [other]


def test_a_lease_that_is_held_stays_as_it_is(connection: redis.Redis) -> None:
    lease, record = taken(connection)
    before = connection.zscore(rq_keys.STARTED, lease.member)
    assert leases.rejoin(connection, lease, "tester", record)
    assert connection.zscore(rq_keys.STARTED, lease.member) == before


def test_an_attempt_that_began_after_the_loss_takes_its_lease_again(connection: redis.Redis) -> None:
    """RQ records when an attempt begins, also where Redis has lost the rest of its entry."""
    lease, record = taken(connection)
    connection.flushall()
    began: dict[Any, Any] = {
        "status": "started",
        "worker_name": "tester",
        "started_at": "2026-11-23T13:02:44.654434Z",
    }
    connection.hset(f"rq:job:{ENTRY}", mapping=began)
    assert not leases.rejoin(connection, lease, "another", record)
    assert leases.rejoin(connection, lease, "tester", record)
    assert leases.held(connection) == [lease]
    again = entries.QueueEntry.fetch(ENTRY, connection=connection, serializer=entries.SERIALIZER)
    assert again.retries_left == record["retries_left"]
