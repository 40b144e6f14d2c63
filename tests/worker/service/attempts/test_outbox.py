"""Proves that events reach Redis in their order, also across an outage, and that progress is thinned.

Does not prove how the server reads them: tests/server does.
"""

import redis
from _capacity.operations import counted

from splatmill.backplane.jobs import events
from splatmill.schema import Event, JobState, LogEvent, PlanEvent, ProgressEvent, StateEvent
from splatmill_worker.service.attempts.attempt import Attempt
from splatmill_worker.service.attempts.outbox import Outbox
from splatmill_worker.service.lock import JobLock
from tests.support.jobs import read_progress
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
    sent = [stored.event for stored in read_progress(connection, "job00001")]
    steps = [event.step for event in sent if isinstance(event, ProgressEvent)]
    assert len(steps) < 50
    assert steps[-1] == 500
    assert len(events.read_log(connection, "job00001")) == 1
    states = [stored.event for stored in events.read_states(connection, "job00001")]
    assert [event.state.value for event in states if isinstance(event, StateEvent)] == [
        "training",
        "exporting",
    ]


def test_a_redis_that_comes_back_empty_is_told_again_that_the_job_runs(connection: redis.Redis) -> None:
    this = Attempt(connection, "job00001", 2, 3, JobLock(connection, "job00001", "a"))
    outbox = Outbox(this)
    said: list[Event] = [
        StateEvent(state=JobState.sfm),
        StateEvent(state=JobState.training),
        PlanEvent(plan={"sh": 3}),
    ]
    for event in (*said, ProgressEvent(stage="training", step=1)):
        outbox.put(event)
    assert outbox.flush()
    connection.flushall()
    outbox.put(ProgressEvent(stage="training", step=2))
    assert outbox.flush()
    outbox.put(StateEvent(state=JobState.exporting))
    outbox.close()
    told = events.read_states(connection, "job00001")
    assert [stored.event for stored in told] == [*said, StateEvent(state=JobState.exporting)]
    assert {(stored.generation, stored.attempt) for stored in told} == {(2, 3)}
    assert events.begin_attempt(connection, "job00001") == 4, "later attempts supersede it"
    holder = this.lock.holder()
    assert holder is not None
    assert (holder.token, holder.attempt, holder.gone()) == ("a", 3, False)


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


def test_an_event_is_one_round_trip(connection: redis.Redis) -> None:
    outbox = Outbox(Attempt(connection, "job00001", 1, 1, JobLock(connection, "job00001", "a")))
    outbox.put(StateEvent(state=JobState.training))
    assert outbox.flush()
    with counted() as operations:
        for line in range(20):
            outbox.put(LogEvent(message=f"line {line}"))
        assert outbox.flush()
    outbox.close()
    assert operations.round_trips == 20
    assert len(events.read_log(connection, "job00001")) == 20
