"""Leases on the clock of Redis: clocks of server and worker that are off, Redis that was away, lost workers.

The clocks are shifted by replacing the functions that RQ and Splatmill read them with. Not proved here: that a worker
prolongs its lease while it trains (tests/service).
"""

import subprocess
import sys
import time
from pathlib import Path

import pytest
import redis

from splatmill.backplane.connection import connect
from splatmill.backplane.queue import leases, lines, queue, rq_keys
from splatmill.backplane.queue.leases import Lease, Reclaim
from tests.support.jobs import write_row
from tests.support.redis_server import RedisServer
from tests.support.servers.queue_entries import take, waiting
from tests.support.waiting import wait_for

SHIFTED = """
import sys, time, datetime, rq.utils, rq.registry, rq.executions, rq.job
real_time, real_now, ahead = time.time, rq.utils.now, float(sys.argv[2])
shifted = lambda: real_now() + datetime.timedelta(seconds=ahead)
time.time = lambda: real_time() + ahead
for module in (rq.utils, rq.registry, rq.executions, rq.job):
    module.now = shifted
from splatmill.backplane.queue import leases
from splatmill.backplane.connection import connect
connection = connect(sys.argv[1])
"""


def shifted(url: str, seconds: float, code: str) -> str:
    """Run code in a process whose clock is this far ahead, and return what it printed."""
    command = [sys.executable, "-c", SHIFTED + code, url, str(seconds)]
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout


@pytest.fixture
def taken(connection: redis.Redis, monkeypatch: pytest.MonkeyPatch) -> Lease:
    """An entry that a worker has just taken, on a Redis that has long been there."""
    monkeypatch.setattr(leases, "LEASE", 2)
    monkeypatch.setattr(lines, "LEASE", 2)
    wait_for(lambda: connection.info("server")["uptime_in_seconds"] >= 2)
    write_row(connection, "job00001")
    assert queue.enqueue(connection, "job00001", 1)
    return take(connection)


def expires(connection: redis.Redis, lease: Lease) -> float:
    """The time at which a lease ends, in seconds by the clock of Redis."""
    score = connection.zscore(rq_keys.STARTED, lease.member)
    assert score is not None
    return float(score)


def expire(connection: redis.Redis, lease: Lease) -> None:
    connection.zadd(rq_keys.STARTED, {lease.member: 1})


@pytest.mark.slow
@pytest.mark.parametrize("ahead", [3600.0, -3600.0])
def test_a_server_with_another_clock_requeues_no_running_attempt(
    taken: Lease, connection: redis.Redis, redis_url: str, ahead: float
) -> None:
    reclaim = "leases.LEASE = 2; print(leases.Reclaim(connection).run())"
    connection.zadd(rq_keys.STARTED, {taken.member: connection.time()[0] + 15})
    assert shifted(redis_url, ahead, reclaim).strip() == "[]"
    assert queue.status(connection, "job00001", 1).state == "running"
    # An expired one is requeued, also where the server's clock is behind.
    expire(connection, taken)
    assert "waiting" in shifted(redis_url, ahead, reclaim)
    assert queue.status(connection, "job00001", 1).state == "waiting"


@pytest.mark.slow
@pytest.mark.parametrize("ahead", [3600.0, -3600.0])
def test_a_worker_with_another_clock_holds_its_entry_for_one_lease(
    taken: Lease, connection: redis.Redis, redis_url: str, ahead: float
) -> None:
    shifted(
        redis_url,
        ahead,
        f"assert leases.prolong(connection, leases.Lease({taken.entry!r}, {taken.execution!r}))",
    )
    assert 0 < expires(connection, taken) - connection.time()[0] <= 15


def test_a_lease_that_is_not_prolonged_expires(taken: Lease, connection: redis.Redis) -> None:
    reclaim = Reclaim(connection)
    assert reclaim.run() == []
    assert leases.prolong(connection, taken)
    assert wait_for(reclaim.run) == [(taken, "waiting")]
    assert waiting(connection) == 1
    assert not leases.prolong(connection, taken), "the worker must learn that it was superseded"


def test_a_heartbeat_at_the_last_moment_keeps_the_entry(taken: Lease, connection: redis.Redis) -> None:
    assert leases.requeue(connection, taken, if_expired=True) == "kept"
    expire(connection, taken)
    assert leases.requeue(connection, taken, if_expired=True) == "waiting"
    assert leases.requeue(connection, taken, if_expired=True) == "kept"
    assert waiting(connection) == 1


def test_a_lease_lasts_no_longer_where_the_clock_of_redis_is_set_back(
    taken: Lease, connection: redis.Redis
) -> None:
    reclaim = Reclaim(connection)
    half_an_hour_back = connection.time()[0] + 1800
    connection.zadd(rq_keys.STARTED, {taken.member: half_an_hour_back})
    assert reclaim.run() == []
    assert 0 < expires(connection, taken) - connection.time()[0] <= leases.LEASE


def test_an_entry_that_was_deleted_is_not_requeued(taken: Lease, connection: redis.Redis) -> None:
    connection.delete(f"rq:job:{taken.entry}")
    expire(connection, taken)
    assert Reclaim(connection).run() == [(taken, "absent")]
    assert waiting(connection) == 0


def test_an_entry_whose_worker_is_lost_again_and_again_fails(taken: Lease, connection: redis.Redis) -> None:
    for attempt in range(1, leases.MAX_LOST):
        assert leases.requeue(connection, taken, if_expired=False) == "waiting", attempt
        taken = take(connection)
    leases.advanced(connection, taken.entry)  # a new checkpoint: all of this counts no more
    for attempt in range(1, leases.MAX_LOST):
        assert leases.requeue(connection, taken, if_expired=False) == "waiting", attempt
        taken = take(connection)
    assert leases.requeue(connection, taken, if_expired=False) == "failed"
    assert queue.status(connection, "job00001", 1).state == "failed"
    assert waiting(connection) == 0


def test_a_member_of_another_form_is_removed(taken: Lease, connection: redis.Redis) -> None:
    connection.zadd(rq_keys.STARTED, {"nonsense": 1, "nonsense:x": 1})
    assert leases.held(connection) == [taken]
    assert connection.zrange(rq_keys.STARTED, 0, -1) == [taken.member.encode()]


@pytest.mark.slow
def test_after_redis_was_away_workers_get_the_time_of_a_lease(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(leases, "LEASE", 3)
    monkeypatch.setattr(lines, "LEASE", 3)
    server = RedisServer(tmp_path)
    server.start()
    try:
        connection = connect(server.url, retries=0)
        write_row(connection, "job00001")
        queue.enqueue(connection, "job00001", 1)
        lease = take(connection)
        reclaim = Reclaim(connection)
        wait_for(lambda: reclaim._trusted())
        server.kill()
        with pytest.raises(redis.ConnectionError):
            reclaim.run()
        expire_at = time.monotonic() + 4  # longer than the lease
        wait_for(lambda: time.monotonic() > expire_at)
        server.start()
        connection.ping()
        # The lease has expired, and neither this process nor one that has just started requeues it.
        assert expires(connection, lease) < connection.time()[0]
        assert reclaim.run() == Reclaim(connection).run() == []
        assert leases.prolong(connection, lease)
        assert queue.status(connection, "job00001", 1).state == "running"
        assert wait_for(reclaim.run) == [(lease, "waiting")]
        connection.close()
    finally:
        server.kill()


def test_a_clock_that_jumps_is_no_reason_to_requeue(
    taken: Lease, connection: redis.Redis, monkeypatch: pytest.MonkeyPatch
) -> None:
    reclaim = Reclaim(connection)
    reclaim.run()
    real = time.monotonic
    # A suspended machine: the wall clock has gone on by an hour, the monotonic one of this process has not.
    monkeypatch.setattr(time, "monotonic", lambda: real() - 3600)
    expire(connection, taken)
    assert reclaim.run() == []
