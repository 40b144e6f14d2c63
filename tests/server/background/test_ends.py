"""The end of a job is announced when its worker reports it: no webhook waits for a loop that looks now and then.

In these tests the reaper and the loop of deliveries look once an hour, so that whatever arrives was told of. Not proved
here: what a delivery holds, and how it is repeated (tests/server/test_webhooks).
"""

import asyncio
from datetime import datetime
from typing import Any, cast

import pytest
import redis

from splatmill import verify_webhook
from splatmill.backplane import keys
from splatmill.backplane.connection import connect_async
from splatmill.backplane.jobs import events, row
from splatmill.backplane.queue import leases
from splatmill.schema import JobState, LogEvent, Problem, ProgressEvent, StateEvent, TrainOptions
from splatmill_server.background import deliveries, ends
from splatmill_server.jobs.records import Jobs
from tests.support.served_app import Serve, ServedApp
from tests.support.servers.queue_entries import take
from tests.support.servers.scripted_server import Reply, ScriptedServer
from tests.support.waiting import wait_for

FAILED = StateEvent(state=JobState.failed, problem=Problem.of("diverged", "It went wrong."))


@pytest.fixture
def app(serve: Serve, peer: ScriptedServer, monkeypatch: pytest.MonkeyPatch) -> ServedApp:
    monkeypatch.setattr(deliveries, "_LOOK_SECONDS", 3600.0)
    return serve(outgoing_allow=peer.url.removeprefix("http://"))


def webhook(app: ServedApp, peer: ScriptedServer) -> Any:
    return app.http.post("/v1/webhooks", json={"url": f"{peer.url}/hook"}).json()


def log_of(app: ServedApp, made: Any) -> Any:
    return app.http.get(f"/v1/webhooks/{made['id']}/deliveries").json()["deliveries"]


def test_a_redis_without_ends_is_not_taken_for_one_that_does_not_answer(redis_url: str) -> None:
    async def waited() -> object:
        client = connect_async(redis_url)
        try:
            return await cast(Any, client.brpop([keys.ENDS], timeout=ends._WAIT))
        finally:
            await client.aclose()

    assert asyncio.run(waited()) is None


@pytest.mark.parametrize("state", ["succeeded", "failed", "cancelled"])
def test_a_webhook_comes_when_the_job_ends(app: ServedApp, peer: ScriptedServer, state: str) -> None:
    made = webhook(app, peer)
    job_id = app.job()
    if state == "cancelled":
        app.http.post(f"/v1/jobs/{job_id}/cancel")
    else:
        app.begin(job_id)
        if state == "succeeded":
            app.finish(job_id)
        else:
            app.say(job_id, FAILED)
    wait_for(lambda: peer.requests)
    payload = verify_webhook(peer.requests[0].headers, peer.requests[0].body, made["secret"])
    assert (payload["type"], payload["data"]["id"]) == (f"job.{state}", job_id)
    assert wait_for(lambda: not app.redis.sismember(keys.ACTIVE, job_id))
    assert app.redis.llen(keys.ENDS) == 0


def test_a_job_that_the_reaper_gives_up_is_announced_at_once(app: ServedApp, peer: ScriptedServer) -> None:
    webhook(app, peer)
    job_id = app.job()
    app.begin(job_id)
    app.say(job_id, StateEvent(state=JobState.sfm), ProgressEvent(stage="features", done=3))
    for _ in range(leases.MAX_LOST):
        leases.requeue(app.redis, take(app.redis), if_expired=False)
    app.service.reaper.tick()
    wait_for(lambda: peer.requests)
    assert app.state(job_id) == "failed"


def test_a_failed_attempt_is_repeated_when_it_is_due(
    app: ServedApp, peer: ScriptedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(deliveries, "PAUSES", (1.0, 1.0))
    made = webhook(app, peer)
    peer.script(Reply(status=500), Reply(), Reply())
    job_id = app.job()
    app.begin(job_id)
    app.say(job_id, FAILED)
    [delivery] = wait_for(lambda: [d for d in log_of(app, made) if d["state"] == "delivered"])
    first, second = (datetime.fromisoformat(attempt["at"]) for attempt in delivery["attempts"])
    assert (second - first).total_seconds() >= 0.9, "the pause is kept"
    # And one that is asked for by hand does not wait for the next look.
    answer = app.http.post(f"/v1/webhooks/{made['id']}/deliveries/{delivery['id']}/repeat")
    assert answer.status_code == 202
    wait_for(lambda: [d for d in log_of(app, made) if len(d["attempts"]) > 2 and d["state"] == "delivered"])
    assert [request.path for request in peer.requests] == 3 * ["/hook"], log_of(app, made)


def test_one_of_several_processes_announces_an_end(
    serve: Serve, app: ServedApp, peer: ScriptedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    retired: list[str] = []
    retire = Jobs.retire

    def noted(self: Jobs, job_id: str) -> None:
        retired.append(job_id)
        retire(self, job_id)

    monkeypatch.setattr(Jobs, "retire", noted)
    serve(outgoing_allow=peer.url.removeprefix("http://"))
    webhook(app, peer)
    for number in range(1, 5):
        job_id = app.job()
        app.begin(job_id)
        app.say(job_id, FAILED)

        def all_came(number: int = number) -> bool:
            return len(peer.requests) == number

        wait_for(all_came)
    assert len(retired) == len(set(retired)) == 4


def test_ends_that_nobody_reads_do_not_fill_redis(
    connection: redis.Redis, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(events, "ENDS_KEPT", 3)
    for number in range(5):
        job_id = f"{number:016x}"
        events.append(connection, job_id, 1, 1, LogEvent(message="begins"))
        events.append(connection, job_id, 1, 1, StateEvent(state=JobState.training))
        events.append(connection, job_id, 1, 1, FAILED)
    assert connection.lrange(keys.ENDS, 0, -1) == [f"{number:016x}".encode() for number in (4, 3, 2)]


def test_an_end_of_a_job_that_is_unknown_or_was_restarted_does_no_harm(
    app: ServedApp, peer: ScriptedServer
) -> None:
    webhook(app, peer)
    waiting = app.job()
    app.redis.lpush(keys.ENDS, "0" * 16, waiting, "no id at all")
    wait_for(lambda: app.redis.llen(keys.ENDS) == 0)
    job_id = app.job()
    app.begin(job_id)
    app.say(job_id, FAILED)
    wait_for(lambda: peer.requests)
    assert app.state(waiting) == "queued"
    assert app.redis.sismember(keys.ACTIVE, waiting)
    job_row = row.read(app.redis, waiting)
    assert job_row is not None
    assert job_row.options == TrainOptions()
