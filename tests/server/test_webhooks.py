"""Webhooks over real HTTP: each end of a job arrives once, signed, and is repeated until it is taken.

The receiver is a real server that is scripted. Not proved here: which addresses are refused (test_outgoing), and the
signature itself (tests/client/sdk/test_webhook_signature.py).
"""

import asyncio
import itertools
import json
from collections.abc import AsyncIterator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
import redis

from splatmill import verify_webhook
from splatmill.backplane import keys
from splatmill.backplane.jobs import row
from splatmill.backplane.jobs.row import JobRow
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import StorageFullError
from splatmill.schema import Job, JobState, Problem, StateEvent
from splatmill_server.background import deliveries
from splatmill_server.base.leases import exclusive
from splatmill_server.base.problems import ProblemError
from tests.support.served_app import Serve, ServedApp, problem, stored
from tests.support.servers.scripted_server import Reply, Request, ScriptedServer, scripted_server
from tests.support.waiting import wait_for


@pytest.fixture
def peer() -> Iterator[ScriptedServer]:
    with scripted_server() as server:
        server.answer = lambda _: Reply(body=b"thanks")
        yield server


@pytest.fixture(autouse=True)
def _short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(deliveries, "PAUSES", (0.01, 0.01, 0.01))
    monkeypatch.setattr(deliveries, "_LOOK_SECONDS", 0.1)


@pytest.fixture
def app(serve: Serve, peer: ScriptedServer) -> ServedApp:
    return serve(outgoing_allow=peer.url.removeprefix("http://"))


def webhook(app: ServedApp, peer: ScriptedServer, **more: Any) -> Any:
    answer = app.http.post("/v1/webhooks", json={"url": f"{peer.url}/hook"} | more)
    assert answer.status_code == 201, answer.text
    assert answer.headers["cache-control"] == "no-store"
    return answer.json()


def log(app: ServedApp, made: Any) -> Any:
    return app.http.get(f"/v1/webhooks/{made['id']}/deliveries").json()["deliveries"]


def over(app: ServedApp, made: Any, count: int = 1) -> Any:
    """The deliveries of a webhook, once this many are over."""
    wait_for(lambda: sum(entry["state"] != "pending" for entry in log(app, made)) == count)
    wait_for(lambda: not any(path.startswith("due/") for path in stored(app)))
    return log(app, made)


def ended(app: ServedApp, state: str = "failed") -> str:
    """A job that has ended, as the reaper finds it."""
    job_id = app.job()
    if state == "cancelled":
        app.http.post(f"/v1/jobs/{job_id}/cancel")
    else:
        app.begin(job_id)
        if state == "succeeded":
            app.finish(job_id)
        else:
            app.say(
                job_id, StateEvent(state=JobState.failed, problem=Problem.of("diverged", "It went wrong."))
            )
    app.service.reaper.tick()
    return job_id


def verified(made: Any, request: Request) -> Any:
    return verify_webhook(request.headers, request.body, made["secret"])


@pytest.mark.parametrize("state", ["succeeded", "failed", "cancelled"])
def test_each_end_of_a_job_arrives_once_and_signed(app: ServedApp, peer: ScriptedServer, state: str) -> None:
    made = webhook(app, peer)
    assert made["secret"].startswith("whsec_")
    job_id = ended(app, state)
    [delivery] = over(app, made)
    for _ in range(3):
        app.service.reaper.tick()
    [request] = peer.requests
    assert (request.method, request.path, request.headers["content-type"]) == (
        "POST",
        "/hook",
        "application/json",
    )
    payload = verified(made, request)
    shown = app.http.get(f"/v1/jobs/{job_id}").json()
    assert payload["type"] == f"job.{state}"
    assert payload["timestamp"] == shown["finished_at"]
    assert Job.model_validate(payload["data"]) == Job.model_validate(shown)
    assert (delivery["job"], delivery["event"], delivery["state"]) == (job_id, f"job.{state}", "delivered")
    assert delivery["message"] == request.headers["webhook-id"]
    assert [(entry["status"], entry["answer"]) for entry in delivery["attempts"]] == [(200, "thanks")]
    # The next generation of the job has an end of its own.
    if state != "succeeded":
        app.http.post(f"/v1/jobs/{job_id}/restart")
        app.http.post(f"/v1/jobs/{job_id}/cancel")
        app.service.reaper.tick()
        over(app, made, 2)
        assert [verified(made, request)["type"] for request in peer.requests] == [
            f"job.{state}",
            "job.cancelled",
        ]
        assert len({request.headers["webhook-id"] for request in peer.requests}) == 2


def test_a_webhook_is_told_what_it_asked_for(app: ServedApp, peer: ScriptedServer) -> None:
    before = app.job()
    app.begin(before)
    failures = webhook(app, peer, events=["job.failed"], name="pager")
    old = app.job()
    app.http.post(f"/v1/jobs/{old}/cancel")
    app.service.reaper.tick()
    app.say(before, StateEvent(state=JobState.failed, problem=Problem.of("diverged", "It went wrong.")))
    app.service.reaper.tick()
    [delivery] = over(app, failures)
    assert delivery["job"] == before  # it began before the webhook, and ended after it
    listed = app.http.get("/v1/webhooks").json()["webhooks"]
    assert [(entry["name"], entry["events"]) for entry in listed] == [("pager", ["job.failed"])]
    assert "secret" not in app.http.get("/v1/webhooks").text
    assert "whsec" not in app.http.get(f"/v1/webhooks/{failures['id']}").text
    assert app.http.delete(f"/v1/webhooks/{failures['id']}").status_code == 204
    problem(app.http.get(f"/v1/webhooks/{failures['id']}"), 404, "webhook_not_found")
    ended(app)
    assert not any(path.startswith(("webhooks", "due", "watched")) for path in stored(app))


def test_requests_that_make_no_webhook_are_named(app: ServedApp, peer: ScriptedServer) -> None:
    def create(**body: Any) -> Any:
        return app.http.post("/v1/webhooks", json=body)

    for url in ("http://127.0.0.1/", "http://10.0.0.1:8080/x", "ftp://example.org", "http://u:p@8.8.8.8/"):
        problem(create(url=url), 422, "url_refused")
    problem(create(url=peer.url, events=["job.started"]), 422, "invalid_request")
    problem(create(url=peer.url, events=[]), 422, "invalid_request")
    problem(app.http.get("/v1/webhooks/0123456789abcdef/deliveries"), 404, "webhook_not_found")
    made = webhook(app, peer)
    address = f"/v1/webhooks/{made['id']}/deliveries"
    problem(app.http.post(f"{address}/0123456789abcdef/repeat"), 404, "delivery_not_found")
    for _ in range(19):
        webhook(app, peer)
    problem(create(url=peer.url), 429, "too_many_requests")


def test_what_is_not_taken_is_sent_again_with_the_same_id(app: ServedApp, peer: ScriptedServer) -> None:
    made = webhook(app, peer)
    replies = iter(
        [Reply(status=500, body=b"x" * 2000), Reply(dropped=True), Reply(status=302), Reply(status=204)]
    )
    peer.answer = lambda _: next(replies)
    ended(app)
    [delivery] = over(app, made)
    assert delivery["state"] == "delivered"
    attempts = delivery["attempts"]
    assert [entry.get("status") for entry in attempts] == [500, None, 302, 204]
    assert attempts[0]["answer"] == "x" * 500
    assert "connection to 127.0.0.1 failed" in attempts[1]["error"]
    assert len({request.headers["webhook-id"] for request in peer.requests}) == 1
    assert len({request.body for request in peer.requests}) == 1
    for request in peer.requests:
        verified(made, request)
    counted = app.http.get("/metrics").text
    assert 'splatmill_webhook_attempts_total{result="retried"} 3.0' in counted
    assert 'splatmill_webhook_attempts_total{result="delivered"} 1.0' in counted


def test_the_pauses_grow_and_retry_after_is_followed(
    app: ServedApp, peer: ScriptedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(deliveries, "PAUSES", (100, 1000))
    made = webhook(app, peer)
    replies = itertools.chain(
        [Reply(status=503, headers={"Retry-After": "500"})], itertools.repeat(Reply(status=503))
    )
    peer.answer = lambda _: next(replies)
    ended(app)

    def pause(attempts: int) -> float:
        wait_for(lambda: len(log(app, made)[0]["attempts"]) == attempts)
        wait_for(lambda: app.redis.keys(keys.lease("*", "*")) == [])
        [delivery] = log(app, made)
        made_at = datetime.fromisoformat(delivery["attempts"][-1]["at"])
        return (datetime.fromisoformat(delivery["next_at"]) - made_at).total_seconds()

    assert 499 < pause(1) < 510
    hurry(app, made)
    assert 899 < pause(2) < 1110
    assert len(peer.requests) == 2


def hurry(app: ServedApp, made: Any) -> None:
    """Make the next attempt of the only delivery due now."""
    service = app.service.webhooks
    [shown] = log(app, made)
    delivery = service.get_delivery(made["id"], shown["id"])
    assert delivery is not None
    delivery = delivery.model_copy(update={"next_at": datetime.now(UTC) - timedelta(seconds=1)})
    service.save_delivery(delivery)
    service.mark(delivery)


def test_a_delivery_that_another_process_makes_is_not_asked_for_all_the_time(
    app: ServedApp, peer: ScriptedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    @asynccontextmanager
    async def held(connection: object, kind: str, name: str) -> AsyncIterator[bool]:
        asked.append(name)
        yield False

    monkeypatch.setattr(deliveries, "lease", held)
    made = webhook(app, peer)
    ended(app)
    wait_for(lambda: asked)
    monkeypatch.setattr(deliveries, "_LOOK_SECONDS", 3600.0)
    before = len(asked)
    for _ in range(20):
        assert [entry["state"] for entry in log(app, made)] == ["pending"]
    assert len(asked) <= before + 2  # of the pause that had begun, and of one that had ended
    assert peer.requests == []


def test_an_address_that_fails_for_long_is_disabled_with_its_reason(
    app: ServedApp, peer: ScriptedServer
) -> None:
    made = webhook(app, peer)
    address = f"/v1/webhooks/{made['id']}"
    peer.answer = lambda _: Reply(status=500)
    ended(app)
    [delivery] = over(app, made)
    assert (delivery["state"], len(delivery["attempts"])) == ("failed", 4)
    hook = app.http.get(address).json()
    assert hook["disabled_at"] is not None
    assert "4 attempts" in hook["disabled_reason"]
    assert "status 500" in hook["disabled_reason"]
    # Nothing is sent to it until it is enabled again.
    second = ended(app)
    wait_for(lambda: f"watched/{second}.json" not in stored(app))
    assert len(log(app, made)) == 1
    assert app.http.post(f"{address}/enable").json().get("disabled_at") is None
    peer.answer = lambda _: Reply()
    repeated = app.http.post(f"{address}/deliveries/{delivery['id']}/repeat")
    assert (repeated.status_code, repeated.json()["state"]) == (202, "pending")
    [delivery] = over(app, made)
    assert (delivery["state"], len(delivery["attempts"])) == ("delivered", 5)
    assert len({request.headers["webhook-id"] for request in peer.requests}) == 1


def test_an_address_that_is_gone_is_disabled_at_once(app: ServedApp, peer: ScriptedServer) -> None:
    made = webhook(app, peer)
    peer.answer = lambda _: Reply(status=410)
    ended(app)
    [delivery] = over(app, made)
    assert (delivery["state"], len(delivery["attempts"])) == ("failed", 1)
    assert "410" in app.http.get(f"/v1/webhooks/{made['id']}").json()["disabled_reason"]


def test_a_new_secret_signs_beside_the_former_one_for_a_day(app: ServedApp, peer: ScriptedServer) -> None:
    made = webhook(app, peer)
    rotated = app.http.post(f"/v1/webhooks/{made['id']}/rotate")
    assert rotated.headers["cache-control"] == "no-store"
    new = rotated.json()
    assert new["secret"] != made["secret"]
    ended(app)
    over(app, made)
    verified(made, peer.requests[0])
    verified(new, peer.requests[0])
    # After the day, only the new one signs.
    record = app.service.webhooks.get(made["id"])
    record.secrets[1].until = datetime.now(UTC)
    app.service.webhooks._write(record)
    ended(app)
    over(app, made, 2)
    verified(new, peer.requests[1])
    assert len(peer.requests[1].headers["webhook-signature"].split()) == 1


def test_a_pending_delivery_survives_a_restart_and_the_loss_of_redis(
    serve: Serve, peer: ScriptedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    allow = peer.url.removeprefix("http://")
    first = serve(outgoing_allow=allow)
    made = webhook(first, peer)

    async def never(_: Request) -> Reply:
        await asyncio.sleep(60)
        return Reply()

    peer.answer = never
    ended(first)
    wait_for(lambda: len(peer.requests) == 1)
    # The process dies in the middle of the attempt, and Redis with it.
    for task in list(first.service.deliveries._running.values()):
        task.cancel()
    wait_for(lambda: first.service.deliveries._running == {} or len(peer.requests) > 1)
    first.redis.flushall()
    peer.answer = lambda _: Reply()
    second = serve(outgoing_allow=allow)
    [delivery] = over(second, made)
    assert delivery["state"] == "delivered"
    assert len({request.headers["webhook-id"] for request in peer.requests}) == 1


def test_two_processes_send_each_end_once(serve: Serve, peer: ScriptedServer) -> None:
    allow = peer.url.removeprefix("http://")
    first, second = serve(outgoing_allow=allow), serve(outgoing_allow=allow)
    made = webhook(first, peer)
    jobs = []
    for _ in range(6):
        job_id = first.job()
        first.begin(job_id)
        first.say(job_id, StateEvent(state=JobState.failed, problem=Problem.of("diverged", "It went wrong.")))
        jobs.append(job_id)
    second.service.reaper.tick()
    first.service.reaper.tick()
    over(second, made, 6)
    assert sorted(verified(made, request)["data"]["id"] for request in peer.requests) == sorted(jobs)


def test_an_end_is_not_skipped_when_storage_fails_or_the_job_is_deleted_or_restarted_at_once(
    app: ServedApp, peer: ScriptedServer
) -> None:
    made = webhook(app, peer)
    job_id = app.job()
    app.begin(job_id)
    # A file where the folder of the deliveries belongs lets every write there fail.
    root = app.service.storage.root
    assert root is not None
    blocked = root / layout.deliveries(made["id"])
    blocked.write_text("in the way")
    app.say(job_id, StateEvent(state=JobState.failed, problem=Problem.of("diverged", "It went wrong.")))
    app.service.reaper.tick()
    assert app.redis.sismember(keys.ACTIVE, job_id)
    blocked.unlink()
    # The reaper has no time to look before the job is restarted, ends again, and is deleted.
    assert app.http.post(f"/v1/jobs/{job_id}/restart").status_code == 202
    app.http.post(f"/v1/jobs/{job_id}/cancel")
    assert app.http.delete(f"/v1/jobs/{job_id}").status_code == 204
    over(app, made, 2)
    assert sorted(verified(made, request)["type"] for request in peer.requests) == [
        "job.cancelled",
        "job.failed",
    ]
    assert not any(path.startswith("watched") for path in stored(app))


def test_the_end_of_a_job_that_redis_lost_is_told_once_it_is_restored(
    app: ServedApp, peer: ScriptedServer
) -> None:
    made = webhook(app, peer)
    finished, kept = app.job(), app.job()
    app.begin(finished)
    app.finish(finished)  # the model is stored, but no process has seen the end
    app.redis.delete(keys.job(finished))
    app.service.jobs.restore([finished, kept])
    app.service.reaper.tick()
    over(app, made, 1)
    assert [verified(made, request)["data"]["id"] for request in peer.requests] == [finished]
    assert verified(made, peer.requests[0])["type"] == "job.succeeded"
    assert row.read(app.redis, kept) is not None


def test_the_end_of_a_job_that_is_restored_while_it_is_retired_is_told(
    app: ServedApp, peer: ScriptedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever retires it first finds no row, and then the restored one."""
    made = webhook(app, peer)
    job = app.job()
    app.begin(job)
    jobs, read = app.service.jobs, row.read
    retire, reads = jobs.retire, itertools.count()

    def lost_at_first(connection: redis.Redis, job_id: str) -> JobRow | None:
        return None if job_id == job and next(reads) == 0 else read(connection, job_id)

    with monkeypatch.context() as patch:
        patch.setattr(jobs, "retire", lambda job_id: None)  # the process that follows ends comes too late
        app.finish(job)
        wait_for(lambda: app.redis.llen(keys.ENDS) == 0)
        patch.setattr(row, "read", lost_at_first)
        retire(job)
    app.service.reaper.tick()
    over(app, made, 1)
    assert verified(made, peer.requests[0])["data"]["id"] == job


def test_old_deliveries_are_deleted_and_unreadable_records_harm_no_other(
    app: ServedApp, peer: ScriptedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, broken = webhook(app, peer), webhook(app, peer)
    app.service.storage.put(layout.webhook_record(broken["id"]), b"{]")
    ended(app)
    over(app, made)
    assert [entry["id"] for entry in app.http.get("/v1/webhooks").json()["webhooks"]] == [made["id"]]
    assert app.service.webhooks.delete_old() == 0
    monkeypatch.setattr("splatmill_server.webhooks.KEPT_DAYS", -1)
    assert app.service.webhooks.delete_old() == 1
    assert log(app, made) == []
    assert json.loads(app.http.get("/v1/webhooks").text)["webhooks"] != []


def test_a_record_that_cannot_be_read_is_logged_without_its_secret(
    app: ServedApp, peer: ScriptedServer, caplog: pytest.LogCaptureFixture
) -> None:
    made = webhook(app, peer)
    path = layout.webhook_record(made["id"])
    record = json.loads(app.service.storage.get(path))
    del record["secrets"][0]["value"]
    app.service.storage.put(path, json.dumps(record | {"url": None, "name": made["secret"]}).encode())
    assert app.service.webhooks.get_or_none(made["id"]) is None
    [warned] = [entry.getMessage() for entry in caplog.records if entry.name == "splatmill.records"]
    assert warned.startswith(f"{path}: cannot be read: url: ")
    assert "secrets.0.value: Field required" in warned
    assert made["secret"] not in warned


@pytest.mark.parametrize(
    "wished", ["9" * 5000, "-1", "\u00b2", "Mon, 01 Jan 2024 00:00:00 +99999999999999999999"]
)
def test_a_pause_that_cannot_be_read_does_not_keep_an_attempt_from_being_counted(
    app: ServedApp, peer: ScriptedServer, wished: str
) -> None:
    made = webhook(app, peer)
    peer.answer = lambda _: Reply(status=503, headers={"Retry-After": wished})
    ended(app)
    [delivery] = over(app, made)
    assert (delivery["state"], len(delivery["attempts"])) == ("failed", 4)
    assert len(peer.requests) == 4


def test_an_error_that_nobody_expected_counts_as_an_attempt(
    app: ServedApp, peer: ScriptedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = webhook(app, peer)

    def broken(*_: object) -> str:
        raise RecursionError

    monkeypatch.setattr(deliveries, "sign", broken)
    ended(app)
    [delivery] = over(app, made)
    assert (delivery["state"], len(delivery["attempts"])) == ("failed", 4)
    assert "unexpected error (RecursionError)" in delivery["attempts"][0]["error"]


def test_an_attempt_that_cannot_be_counted_is_not_made(app: ServedApp, peer: ScriptedServer) -> None:
    """As on a full disk: it would be made again and again, with nobody to count."""
    made = webhook(app, peer)
    peer.answer = lambda _: Reply(status=503)
    refusing = app.service.webhooks.storage.put
    tried: list[str] = []

    def full(path: str, data: bytes) -> None:
        if path.startswith("webhooks/") and "/deliveries/" in path:
            tried.append(path)
            raise StorageFullError("The disk is full.")
        refusing(path, data)

    app.service.webhooks.storage.put = full  # type: ignore[assignment]  # a full disk
    ended(app)
    wait_for(lambda: len(tried) >= 3)
    assert peer.requests == []
    app.service.webhooks.storage.put = refusing  # type: ignore[method-assign]  # room again
    [delivery] = over(app, made)
    assert len(delivery["attempts"]) == len(peer.requests) == 4


def test_of_two_changes_of_a_webhook_at_once_neither_is_lost(app: ServedApp, peer: ScriptedServer) -> None:
    made = webhook(app, peer)
    service = app.service.webhooks
    with ThreadPoolExecutor(3) as pool:
        with exclusive(app.redis, "webhook", made["id"]):
            # The others wait, and read what is written here.
            rotation = pool.submit(service.rotate, made["id"])
            end = pool.submit(service.disable, made["id"], "gone")
            wait_for(lambda: rotation.running() and end.running())
            record = service.get(made["id"])
            service._write(record.model_copy(update={"name": "renamed"}))
            assert not rotation.done()
            assert not end.done()
        rotated = rotation.result(20)
        end.result(20)
    hook = service.get(made["id"])
    assert (hook.name, hook.disabled_reason) == ("renamed", "gone")
    assert [secret.value for secret in hook.secrets] == [rotated.secret, made["secret"]]


def test_a_webhook_that_is_deleted_while_it_is_changed_stays_deleted(
    app: ServedApp, peer: ScriptedServer
) -> None:
    made = webhook(app, peer)
    service = app.service.webhooks
    with ThreadPoolExecutor(1) as pool:
        with exclusive(app.redis, "webhook", made["id"]):
            change = pool.submit(service.enable, made["id"])
            wait_for(change.running)
            app.service.storage.delete(layout.webhook_record(made["id"]))
        with pytest.raises(ProblemError, match="no webhook"):
            change.result(20)
    assert service.list(None) == []
