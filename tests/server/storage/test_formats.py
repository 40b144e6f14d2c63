"""Records of other versions: a stored copy of the first version is served, and one unreadable record harms no other.

The stored copy is real (tests/support/stored/make_formats.py ran that version). Not proved here: that a worker resumes
from what the first version stored (tests/worker/test_formats.py reads it).
"""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, cast

import pytest
import redis

from splatmill.backplane import keys
from splatmill.backplane.queue import entries, queue
from splatmill.backplane.storage import layout
from splatmill.schema import EVENT, JobState, LogEvent, StateEvent
from tests.support.served_app import Serve, ServedApp, problem
from tests.support.servers.queue_entries import waiting
from tests.support.servers.server_events import brief, follow
from tests.support.stored.formats import job_ids, restore_redis, restore_storage
from tests.support.waiting import wait_for

pytestmark = pytest.mark.slow  # a server for each case


@pytest.fixture
def stored_copy(serve: Serve, connection: redis.Redis, tmp_path: Path) -> ServedApp:
    """The server of today on Redis and storage as the first version left them."""
    restore_redis(connection)
    restore_storage(tmp_path / "data" / "storage")
    return serve()


def test_the_server_starts_on_what_the_first_version_stored(stored_copy: ServedApp) -> None:
    http, ids = stored_copy.http, job_ids()
    listed = {job["id"]: job for job in http.get("/v1/jobs").json()["jobs"]}
    assert {name: listed[job_id]["state"] for name, job_id in ids.items()} == {
        "succeeded": "succeeded",
        "failed": "failed",
        "cancelled": "cancelled",
        "interrupted": "queued",
        "queued": "queued",
    }
    assert all(http.get(f"/v1/jobs/{job_id}").json() == job for job_id, job in listed.items())
    assert listed[ids["failed"]]["problem"]["code"] == "no_images"
    assert listed[ids["succeeded"]]["options"]["max_gaussians"] == 400
    assert listed[ids["queued"]]["options"]["test_views"] == ["still_0001.jpg"]
    again = {"Idempotency-Key": "queued"}
    known = listed[ids["queued"]]
    options = {"preset": "draft", "seed": 1, "sh_degree": 0, "max_gaussians": 400, "gaps": "off"}
    options |= {"far_shell": "off", "steps": 5, "test_views": ["still_0001.jpg"]}
    body = {"capture": known["capture"], "name": "queued", "options": options}
    assert http.post("/v1/jobs", json=body, headers=again).json()["id"] == known["id"]


def test_events_logs_models_and_captures_of_the_first_version_are_served(stored_copy: ServedApp) -> None:
    http, ids = stored_copy.http, job_ids()
    done = ids["succeeded"]
    records = follow(stored_copy, done)
    kinds = {event["event"]["type"] for event in records}
    assert {"state", "plan"} <= kinds <= set(_event_types())  # the others are left out a minute after the end
    assert http.get(f"/v1/jobs/{done}/curve").json()["rows"][-1]["step"] == 60
    assert brief(records)[-1] == "succeeded"
    assert "usable photo" in http.get(f"/v1/jobs/{ids['failed']}/logs").json()["lines"][-1]["message"]
    model = http.get(f"/v1/models/{done}").json()
    assert (model["gaussians"], model["sh_degree"], model["name"]) == (400, 0, "succeeded")
    assert http.get("/v1/models").json()["models"] == [model]
    assert len(http.get(f"/v1/models/{done}/cameras").json()["cameras"]) == 8
    assert http.get(f"/v1/jobs/{done}/report").json()["curve"][-1]["step"] == 60
    assert http.get(f"/v1/jobs/{done}/preview").content[:2] == b"\xff\xd8"
    captures = http.get("/v1/captures").json()["captures"]
    assert {capture["name"] for capture in captures} == {"still life", "no photos"}
    assert len(http.get(f"/v1/captures/{model_capture(stored_copy, done)}").json()["files"]) == 9


def has_state(app: ServedApp, path: str, state: str) -> bool:
    return bool(app.http.get(path).json()["state"] == state)


def test_the_reaper_finds_the_jobs_of_the_first_version_in_the_queue(stored_copy: ServedApp) -> None:
    stored_copy.service.reaper.tick()
    ids = job_ids()
    assert waiting(stored_copy.redis) == 2
    assert stored_copy.redis.smembers(keys.ACTIVE) == {ids["interrupted"].encode(), ids["queued"].encode()}
    for name in ("interrupted", "queued"):
        path = f"/v1/jobs/{ids[name]}"
        assert stored_copy.http.post(f"{path}/cancel").status_code == 202
        # The server's own reaper may be at the job at this moment; then its next tick cancels the job.
        wait_for(partial(has_state, stored_copy, path, "cancelled"))
    assert stored_copy.http.post(f"/v1/jobs/{ids['failed']}/restart").json()["state"] == "queued"
    for job_id in (ids["succeeded"], ids["cancelled"]):
        assert stored_copy.http.delete(f"/v1/jobs/{job_id}").status_code == 204


def test_finished_jobs_of_the_first_version_outlive_redis(
    stored_copy: ServedApp, connection: redis.Redis
) -> None:
    connection.flushall()
    job = stored_copy.http.get(f"/v1/jobs/{job_ids()['succeeded']}").json()
    assert (job["state"], job["options"]["steps"]) == ("succeeded", 60)
    assert job["plan"]["max_gaussians"] == 400


def model_capture(app: ServedApp, job_id: str) -> str:
    return str(app.http.get(f"/v1/jobs/{job_id}").json()["capture"])


def _event_types() -> list[str]:
    schema = EVENT.json_schema()
    return list(schema["discriminator"]["mapping"])


Harm = Callable[[ServedApp, str], object]


def _set(field: str, value: str) -> Harm:
    return lambda app, job_id: app.redis.hset(keys.job(job_id), field, value)


def _options(**changed: object) -> Harm:
    def harm(app: ServedApp, job_id: str) -> None:
        stored = json.loads(app.redis.hget(keys.job(job_id), "options") or "{}")
        app.redis.hset(keys.job(job_id), "options", json.dumps(stored | changed))

    return harm


def _without(field: str) -> Harm:
    return lambda app, job_id: app.redis.hdel(keys.job(job_id), field)


@pytest.mark.parametrize(
    ("harm", "left"),
    [
        (_options(removed_option=3), True),
        (_options(preset="ultra", steps=-1), True),
        (_options(test_views=["a", "a"]), True),
        (_set("new_field", "x"), True),
        (_set("options", "{}"), True),
        (_without("generation"), True),
        (_without("format"), True),
        (
            _set("verdict", '{"state": "failed", "at": "2026-01-01T00:00:00Z", "problem": {"status": 5}}'),
            True,
        ),
        (_set("format", "2"), False),
        (_set("format", "two"), False),
        (_without("options"), False),
        (_set("options", "[1]"), False),
        (_set("options", "not json"), False),
        (_set("created_at", "yesterday"), False),
        (_set("verdict", '{"state": "paused"}'), False),
        (_set("name", b"\xff\xfe".decode("latin-1")), True),
    ],
)
def test_a_row_of_another_version_harms_no_other_job(app: ServedApp, harm: Harm, left: bool) -> None:
    capture = app.capture()
    other, harmed = app.job(capture), app.job(capture, steps=7)
    queue.forget(app.redis, other, 1)  # what the reaper has to repair
    harm(app, harmed)
    listed = [job["id"] for job in app.http.get("/v1/jobs").json()["jobs"]]
    assert listed == ([harmed, other] if left else [other])
    answer = app.http.get(f"/v1/jobs/{harmed}")
    if left:
        assert answer.json()["capture"] == capture
    else:
        assert harmed in problem(answer, 500, "job_corrupt")["detail"]
        problem(app.http.get(f"/v1/jobs/{harmed}/events"), 500, "job_corrupt")
    app.service.reaper.tick()
    assert queue.status(app.redis, other, 1).state == "waiting"
    # Another version may be able to read it: it is not forgotten, until somebody deletes it.
    assert app.redis.exists(keys.job(harmed))
    if not left:
        assert harmed.encode() in app.redis.smembers(keys.ACTIVE)
        assert app.http.delete(f"/v1/jobs/{harmed}").status_code == 204
        assert not app.redis.exists(keys.job(harmed))


def test_an_unreadable_row_is_logged_once_with_its_id(
    app: ServedApp, caplog: pytest.LogCaptureFixture
) -> None:
    job_id = app.job()
    _set("options", "not json")(app, job_id)
    for _ in range(3):
        app.http.get("/v1/jobs")
    assert [
        job_id in record.getMessage() for record in caplog.records if record.name == "splatmill.records"
    ] == [True]


def append(app: ServedApp, job_id: str, event: object, stream: str = "states", **fields: str) -> str:
    """Append an entry as another version might, and return its id."""
    key = keys.states(job_id) if stream == "states" else keys.progress(job_id)
    text = event if isinstance(event, str) else json.dumps(event)
    entry: Any = {"g": "1", "a": "1", "e": text} | fields
    return cast(bytes, app.redis.xadd(key, entry)).decode()


def test_events_of_another_version_are_left_out_and_the_others_arrive(app: ServedApp) -> None:
    job_id = app.job()
    app.begin(job_id)
    for stream in ("states", "progress"):
        append(app, job_id, {"type": "weather", "rain": True}, stream)
        append(app, job_id, "not json", stream)
        append(app, job_id, "[]", stream)
        append(app, job_id, {"type": "state", "state": "paused"}, stream)
        append(app, job_id, {"type": "state", "state": "failed"}, stream, format="2")
        app.redis.xadd(keys.states(job_id), {"unknown": "entry"})
    progress = {"type": "progress", "stage": "x", "done": 3, "total": "many", "new": 1}
    entry = append(app, job_id, progress, "progress")
    app.redis.hset(keys.latest(job_id), "progress", f"{entry} 1 1 1 {json.dumps(progress)}")
    app.say(job_id, LogEvent(message="still heard"))
    append(app, job_id, {"type": "weather"}, "progress")
    job = app.http.get(f"/v1/jobs/{job_id}").json()
    assert (job["state"], job["progress"]["done"], job["progress"]["total"]) == ("preparing", 3, None)
    assert app.http.get("/v1/jobs").json()["jobs"][0]["id"] == job_id
    assert [line["message"] for line in app.http.get(f"/v1/jobs/{job_id}/logs").json()["lines"]] == [
        "still heard"
    ]
    app.service.reaper.tick()
    append(app, job_id, {"type": "state", "state": "failed", "problem": {"status": 5}})
    records = follow(app, job_id)
    assert brief(records) == ["queued", "preparing", 3, "log", "failed"]
    for index, event in enumerate(records):
        assert follow(app, job_id, event["id"]) == records[index + 1 :]
    assert app.state(job_id) == "failed"


def test_records_in_storage_of_another_version_harm_no_other(app: ServedApp) -> None:
    good, broken = app.job(), app.job()
    for job_id in (good, broken):
        app.begin(job_id)
        app.finish(job_id)
    path = layout.job_record(good)
    record = json.loads(app.service.storage.get(path))
    record["options"] |= {"removed_option": 1, "preset": "ultra"}
    record |= {"new": {}, "progress": {"stage": 7}}
    app.service.storage.put(path, json.dumps(record).encode())
    for text in (b"not json", b"[]", b"{}", json.dumps(record | {"format": 2}).encode()):
        app.service.storage.put(layout.job_record(broken), text)
        assert [model["id"] for model in app.http.get("/v1/models").json()["models"]] == [good]
        problem(app.http.get(f"/v1/models/{broken}"), 500, "model_corrupt")
    app.redis.flushall()
    job = app.http.get(f"/v1/jobs/{good}").json()
    assert (job["state"], job["options"]["preset"], job["progress"]) == ("succeeded", "balanced", None)


def test_captures_of_another_version_harm_no_other(app: ServedApp) -> None:
    good, broken = app.capture(), app.capture()
    path = layout.capture_record(good)
    record = json.loads(app.service.storage.get(path))
    assert record["format"] == 1
    app.service.storage.put(path, json.dumps(record | {"new": 1, "name": ["a"]}).encode())
    app.service.storage.put(f"captures/{good}/files/depths/a.png", b"a role of a later version")
    for text in (b"not json", b"[]", json.dumps(record | {"format": 2}).encode()):
        app.service.storage.put(layout.capture_record(broken), text)
        app.redis.delete(keys.LISTED)  # a record never changes, so it is read once
        listed = app.http.get("/v1/captures").json()["captures"]
        assert [capture["id"] for capture in listed] == [good]
    assert len(app.http.get(f"/v1/captures/{good}").json()["files"]) == 2


def test_an_error_over_one_job_does_not_keep_the_reaper_from_the_others(app: ServedApp) -> None:
    first, second = sorted([app.job(), app.job()])
    for job_id in (first, second):
        queue.forget(app.redis, job_id, 1)
    app.redis.hset(f"rq:job:{entries.rq_id(first, 1)}", mapping={"status": "unheard of", "created_at": "?"})
    app.service.reaper.tick()
    assert queue.status(app.redis, second, 1).state == "waiting"


def test_requests_stay_strict_and_new_records_carry_their_format(app: ServedApp) -> None:
    capture = app.capture()
    refused = app.http.post("/v1/jobs", json={"capture": capture, "options": {"removed_option": 1}})
    problem(refused, 422, "unknown_option")
    problem(app.http.post("/v1/jobs", json={"capture": capture, "new": 1}), 422, "invalid_request")
    job_id = app.job(capture)
    app.begin(job_id)
    app.say(job_id, StateEvent(state=JobState.training))
    assert app.redis.hget(keys.job(job_id), "format") == b"1"
    entries: Any = app.redis.xrange(keys.states(job_id))
    assert {fields[b"format"] for _, fields in entries} == {b"1"}
