"""Proves that events reach Redis in their order, also across an outage, and that progress is thinned.

Does not prove how the server reads them: tests/server does.
"""

import redis

from splatmill.backplane import events
from splatmill.schema import JobState, LogEvent, ProgressEvent, StateEvent
from splatmill_worker.service.attempt import Attempt
from splatmill_worker.service.lock import JobLock
from splatmill_worker.service.outbox import Outbox
from tests.support.redis_server import RedisServer


def test_events_keep_their_order_and_progress_is_thinned(connection: redis.Redis) -> None:
    this = Attempt(connection, "job00001", 1, 1, JobLock(connection, "job00001", "a"))
    outbox = Outbox(this)
    outbox.put(StateEvent(state=JobState.training))
    for step in range(1, 501):
        outbox.put(ProgressEvent(stage="training", step=step))
    outbox.put(LogEvent(message="done"))
    outbox.put(StateEvent(state=JobState.exporting))
    outbox.close()
    sent = [stored.event for stored in events.read_progress(connection, "job00001")]
    steps = [event.step for event in sent if isinstance(event, ProgressEvent)]
    assert len(steps) < 50
    assert steps[-1] == 500
    assert len(events.read_log(connection, "job00001")) == 1
    states = [stored.event for stored in events.read_states(connection, "job00001")]
    assert [event.state.value for event in states if isinstance(event, StateEvent)] == [
        "training",
        "exporting",
    ]


def test_what_is_said_while_redis_is_away_arrives_when_it_is_back(redis_server: RedisServer) -> None:
    connection = redis_server.connection
    outbox = Outbox(Attempt(connection, "job00001", 1, 1, JobLock(connection, "job00001", "a")))
    outbox.put(LogEvent(message="before"))
    assert outbox.flush(10)
    redis_server.kill()
    outbox.put(LogEvent(message="meanwhile"))
    outbox.put(StateEvent(state=JobState.exporting))
    assert not outbox.flush(0.3)
    redis_server.start()
    outbox.put(LogEvent(message="after"))
    outbox.close(20)
    sent = [stored.event for stored in events.read_log(connection, "job00001")]
    assert [event.message for event in sent if isinstance(event, LogEvent)] == [
        "before",
        "meanwhile",
        "after",
    ]
    assert len(events.read_states(connection, "job00001")) == 1
