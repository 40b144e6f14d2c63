"""A real Redis that answers and refuses writes: a job continues, all its events arrive, and none is requeued beside it.

Does not prove what happens while Redis is away: tests/worker/service/attempts/test_outbox.py and tests/service do.
"""

import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import redis

from splatmill.backplane.connection import connect
from splatmill.backplane.jobs import events
from splatmill.backplane.queue import leases, queue, rq_keys
from splatmill.backplane.refusal import RedisRefuses
from splatmill.schema import JobState, LogEvent, StateEvent
from splatmill_worker.service.attempts.attempt import Attempt
from splatmill_worker.service.attempts.outbox import Outbox
from splatmill_worker.service.lock import JobLock
from tests.support.jobs import messages, read_job, write_row
from tests.support.redis_server import RedisServer
from tests.support.servers.queue_entries import take
from tests.support.up import running_worker, scripted, worker_environment
from tests.support.waiting import wait_for

JOB = "job00001"


def failing_disk(connection: Any) -> None:
    """Let the next dump fail, after which Redis refuses writes."""
    (folder,) = (value for name, value in connection.config_get("dir").items() if name in ("dir", b"dir"))
    (Path(os.fsdecode(folder)) / "dump.rdb").mkdir(exist_ok=True)  # a folder, which the dump cannot replace
    connection.config_set("save", "3600 1")
    connection.set("something", "to dump")
    connection.bgsave()
    wait_for(lambda: connection.info("persistence")["rdb_last_bgsave_status"] == "err")


def working_disk(connection: Any) -> None:
    connection.config_set("stop-writes-on-bgsave-error", "no")


REFUSALS: dict[str, tuple[Callable[[Any], object], Callable[[Any], object]]] = {
    "MISCONF": (failing_disk, working_disk),
    "OOM": (lambda c: c.config_set("maxmemory", "1"), lambda c: c.config_set("maxmemory", "0")),
    "NOREPLICAS": (
        lambda c: c.config_set("min-replicas-to-write", "1"),
        lambda c: c.config_set("min-replicas-to-write", "0"),
    ),
    "READONLY": (lambda c: c.replicaof("127.0.0.1", "1"), lambda c: c.replicaof("NO", "ONE")),
    "NOPERM": (
        lambda c: c.execute_command("ACL", "SETUSER", "default", "-@write"),
        lambda c: c.execute_command("ACL", "SETUSER", "default", "+@all"),
    ),
}


@pytest.mark.parametrize("code", REFUSALS)
def test_events_wait_for_a_redis_that_refuses_them(redis_server: RedisServer, code: str) -> None:
    refuse, allow = REFUSALS[code]
    plain = redis.Redis(unix_socket_path=str(redis_server.path), decode_responses=True)
    connection = redis_server.connection
    outbox = Outbox(Attempt(connection, JOB, 1, 1, JobLock(connection, JOB, "a")))
    outbox.put(LogEvent(message="before"))
    assert outbox.flush(10)
    refuse(plain)
    outbox.put(LogEvent(message="meanwhile"))
    outbox.put(StateEvent(state=JobState.exporting))
    assert not outbox.flush(1.0)
    assert outbox.trouble is not None
    assert code in outbox.trouble
    pipe = connection.pipeline()
    pipe.set("a", 1)
    with pytest.raises(RedisRefuses, match=code):
        pipe.execute()
    with pytest.raises(RedisRefuses, match=code):
        connection.eval("return redis.call('SET', KEYS[1], '1')", 1, "a")
    allow(plain)
    assert outbox.close(20)
    assert outbox.trouble is None
    sent = [stored.event for stored in events.read_log(connection, JOB)]
    assert [event.message for event in sent if isinstance(event, LogEvent)] == ["before", "meanwhile"]
    assert len(events.read_states(connection, JOB)) == 1
    plain.close()


def test_an_event_that_redis_never_takes_does_not_hold_up_the_end_for_ever(redis_server: RedisServer) -> None:
    connection = redis_server.connection
    outbox = Outbox(Attempt(connection, JOB, 1, 1, JobLock(connection, JOB, "a")))
    connection.set("splatmill:job:job00001:log", "not a stream")
    outbox.put(LogEvent(message="lost"))
    assert not outbox.close(1.0)
    assert "WRONGTYPE" in str(outbox.trouble)


def test_nothing_is_requeued_while_heartbeats_are_refused_nor_right_after(
    redis_server: RedisServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    connection = redis_server.connection
    clock = [1000.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(leases, "LEASE", 1)
    write_row(connection, JOB)
    queue.enqueue(connection, JOB, 1)
    lease = take(connection)
    reclaim = leases.Reclaim(connection)
    refuse, allow = REFUSALS["NOREPLICAS"]
    refuse(connection)
    with pytest.raises(RedisRefuses):
        reclaim.run()
    allow(connection)
    connection.zadd(rq_keys.STARTED, {lease.member: 0})  # expired meanwhile
    assert reclaim.run() == []
    assert leases.prolong(connection, lease)


def attempts(folder: Path) -> list[Any]:
    diary = folder / "diary"
    return [json.loads(line) for line in diary.read_text().splitlines()] if diary.exists() else []


@pytest.mark.slow
@pytest.mark.parametrize("code", ["OOM", "MISCONF"])
def test_a_job_goes_on_while_redis_refuses_writes(
    redis_server: RedisServer, tmp_path: Path, code: str
) -> None:
    refuse, allow = REFUSALS[code]
    storage = scripted(tmp_path, steps=60, pause=0.05)
    with (
        connect(redis_server.url, retries=0) as connection,
        running_worker(worker_environment(redis_server, storage, tmp_path)),
    ):
        write_row(connection, JOB)
        queue.enqueue(connection, JOB, 1)
        wait_for(lambda: attempts(tmp_path))
        refuse(connection)
        trained = tmp_path / "data" / "work" / JOB / "run" / "out" / "cameras.json"
        wait_for(trained.is_file, 60)  # the training ends meanwhile
        assert not read_job(connection, JOB).state.final
        allow(connection)
        job = wait_for(lambda: (row := read_job(connection, JOB)).state.final and row, 60)
        assert (job.state, job.attempt) == ("succeeded", 1)
        assert len(attempts(tmp_path)) == 1
        states = [stored.event for stored in events.read_states(connection, JOB)]
        assert [event.state for event in states if isinstance(event, StateEvent)] == [
            *("preparing", "sfm", "training", "exporting", "succeeded")
        ]
        wait_for(lambda: queue.status(connection, JOB, 1).state == "finished")


@pytest.mark.slow
def test_an_attempt_ends_by_name_after_the_limit_and_the_job_goes_on(
    redis_server: RedisServer, tmp_path: Path
) -> None:
    refuse, allow = REFUSALS["OOM"]
    storage = scripted(tmp_path, steps=20, pause=0.05)
    environment = worker_environment(redis_server, storage, tmp_path, SPLATMILL_REDIS_PATIENCE="1")
    with (
        connect(redis_server.url, retries=0) as connection,
        running_worker(environment),
    ):
        write_row(connection, JOB)
        queue.enqueue(connection, JOB, 1)
        (attempt,) = wait_for(lambda: attempts(tmp_path))
        refuse(connection)
        wait_for(lambda: not Path(f"/proc/{attempt['pid']}").exists(), 60)
        allow(connection)
        job = wait_for(lambda: (row := read_job(connection, JOB)).state.final and row, 60)
        assert job.state == "succeeded"
        assert any("Redis took no events" in message for message in messages(connection, JOB))


@pytest.mark.slow
def test_a_worker_begins_when_redis_takes_writes(redis_server: RedisServer, tmp_path: Path) -> None:
    refuse, allow = REFUSALS["NOREPLICAS"]
    environment = worker_environment(redis_server, scripted(tmp_path, steps=1), tmp_path)
    with connect(redis_server.url, retries=0) as connection:
        write_row(connection, JOB)
        queue.enqueue(connection, JOB, 1)
        refuse(connection)
        with running_worker(environment):
            time.sleep(3)  # a worker that gives up at once would be gone
            allow(connection)
            job = wait_for(lambda: (row := read_job(connection, JOB)).state.final and row, 60)
            assert job.state == "succeeded"
