"""Proves that a worker learns from Redis whether anybody looks, and that snapshots reach Redis and are announced.

Does not prove what is in a snapshot (tests/worker/pipeline/test_live.py), nor
how it is served (tests/server/jobs/test_live.py).
"""

import redis

from splatmill.backplane import keys
from splatmill.schema import Event, SnapshotEvent
from splatmill_worker.service.attempts.attempt import Attempt
from splatmill_worker.service.attempts.live_view import KEPT_SECONDS, LiveView
from splatmill_worker.service.lock import JobLock
from tests.support.redis_server import RedisServer
from tests.support.waiting import wait_for

JOB = "job00001"


def event(step: int) -> SnapshotEvent:
    return SnapshotEvent(step=step, seconds=1.0, gaussians=10, shown=10, bytes=3)


def live_view(connection: redis.Redis) -> tuple[LiveView, list[Event]]:
    said: list[Event] = []
    return LiveView(Attempt(connection, JOB, 1, 3, JobLock(connection, JOB, "a")), said.append), said


def test_onlookers_are_there_while_their_key_is(connection: redis.Redis) -> None:
    view, _ = live_view(connection)
    assert not view.are_there()
    connection.set(keys.watched(JOB), b"1")
    wait_for(view.are_there)
    connection.delete(keys.watched(JOB))
    wait_for(lambda: not view.are_there())
    view.close()


def test_a_snapshot_is_announced_once_redis_has_it(connection: redis.Redis) -> None:
    view, said = live_view(connection)
    view.show(b"ply", event(40))
    wait_for(lambda: said)
    assert said == [event(40)]
    assert connection.hgetall(keys.snapshot(JOB)) == {b"ply": b"ply", b"tag": b"3-40"}
    assert 0 < connection.ttl(keys.snapshot(JOB)) <= KEPT_SECONDS
    view.close()


def test_an_outage_drops_snapshots_and_passes(redis_server: RedisServer) -> None:
    view, said = live_view(redis_server.connection)
    redis_server.connection.set(keys.watched(JOB), b"1")
    wait_for(view.are_there)
    redis_server.kill()
    view.show(b"lost", event(1))
    wait_for(lambda: not view.are_there())
    redis_server.start()
    redis_server.connection.set(keys.watched(JOB), b"1")
    wait_for(view.are_there)
    view.show(b"kept", event(2))
    wait_for(lambda: said)
    assert said == [event(2)]
    view.close()
