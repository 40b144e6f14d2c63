"""Server-sent events over a real connection: order, ids that survive a reconnect anywhere, heartbeats, the end.

Not proved here: what a browser's EventSource does with them, and the SDK's reader (tests/client).
"""

import json
import threading
import time
from typing import Any

import pytest

from splatmill.backplane import keys
from splatmill.backplane.jobs import events
from splatmill.schema import JobState, LogEvent, MetricEvent, PlanEvent, Problem, ProgressEvent, StateEvent
from splatmill_server.jobs.shrinking import shrink
from tests.support.jobs import read_progress
from tests.support.served_app import Serve, ServedApp, problem
from tests.support.servers.server_events import brief, follow, messages


def a_whole_job(app: ServedApp) -> str:
    job_id = app.job()
    app.begin(job_id)
    app.say(job_id, StateEvent(state=JobState.sfm), ProgressEvent(stage="features", done=1))
    app.say(
        job_id,
        StateEvent(state=JobState.training),
        PlanEvent(plan={"sh": 3}),
        LogEvent(message="a\nb\u2028c"),
    )
    app.say(job_id, *(ProgressEvent(stage="training", done=n) for n in range(2, 6)))
    app.say(job_id, StateEvent(state=JobState.succeeded))
    return job_id


WHOLE = ["queued", "preparing", "sfm", 1, "training", "plan", "log", 2, 3, 4, 5, "succeeded"]


def test_a_stream_tells_everything_once_in_order_and_ends(app: ServedApp) -> None:
    records = follow(app, a_whole_job(app))
    # Both streams are put in order by Redis's clock; within one of its milliseconds progress goes first.
    assert sorted(map(str, brief(records))) == sorted(map(str, WHOLE))
    assert [b for b in brief(records) if isinstance(b, int)] == [1, 2, 3, 4, 5]
    assert [b for b in brief(records) if b in JobState.__members__] == [
        *("queued", "preparing", "sfm", "training", "succeeded"),
    ]
    assert brief(records)[-1] == "succeeded"
    assert [e["attempt"] for e in records] == [0] + [1] * 11


def test_a_reconnect_after_any_event_goes_on_exactly_there(app: ServedApp) -> None:
    job_id = a_whole_job(app)
    records = follow(app, job_id)
    for index, event in enumerate(records):
        assert follow(app, job_id, event["id"]) == records[index + 1 :]
    # A browser stops reconnecting at 204 and at nothing else.
    answer = app.http.get(f"/v1/jobs/{job_id}/events", headers={"Last-Event-ID": records[-1]["id"]})
    assert answer.status_code == 204


def test_events_arrive_while_they_happen_with_heartbeats_between(serve: Serve) -> None:
    app = serve(heartbeat=0.05)
    job_id = app.job()
    with app.http.stream("GET", f"/v1/jobs/{job_id}/events") as answer:
        stream = messages(answer.iter_lines())
        assert "retry" in next(stream)
        assert json.loads(next(stream)["data"])["event"]["state"] == "queued"
        assert next(stream) == {"": "still here"}
        app.begin(job_id)
        first = next(m for m in stream if "data" in m)
        assert json.loads(first["data"])["event"]["state"] == "preparing"
        app.say(job_id, StateEvent(state=JobState.succeeded))
        rest = [json.loads(m["data"]) for m in stream if "data" in m]
        assert brief(rest) == ["succeeded"]


@pytest.mark.slow
def test_a_cancelled_job_ends_its_stream_with_the_servers_word(app: ServedApp) -> None:
    job_id = app.job()
    records: list[dict[str, Any]] = []
    reader = threading.Thread(target=lambda: records.extend(follow(app, job_id)))
    reader.start()
    assert app.http.post(f"/v1/jobs/{job_id}/cancel").json()["state"] == "cancelled"
    reader.join(60)
    assert brief(records) == ["queued", "cancelled"]
    assert {e["attempt"] for e in records} == {0}
    assert follow(app, job_id, records[0]["id"]) == records[1:]
    assert follow(app, job_id, records[1]["id"]) == []


def test_what_a_superseded_attempt_still_says_is_not_told(app: ServedApp) -> None:
    job_id = app.job()
    app.begin(job_id)
    app.begin(job_id)
    app.say(job_id, StateEvent(state=JobState.succeeded), attempt=1)
    app.say(job_id, ProgressEvent(stage="training", done=99), attempt=1)
    app.say(job_id, ProgressEvent(stage="training", done=7), StateEvent(state=JobState.succeeded))
    records = follow(app, job_id)
    assert brief(records) == ["queued", "preparing", "preparing", 7, "succeeded"]


def test_a_cancelled_job_whose_last_state_did_not_count_still_ends_its_stream(app: ServedApp) -> None:
    job_id = app.job()
    app.begin(job_id)
    app.begin(job_id)
    app.say(job_id, StateEvent(state=JobState.sfm), attempt=1)
    app.http.post(f"/v1/jobs/{job_id}/cancel")
    app.service.reaper.tick()
    shrink(app.redis, job_id)
    records = follow(app, job_id)
    assert brief(records) == ["queued", "preparing", "preparing", "cancelled"]
    assert follow(app, job_id, records[-1]["id"]) == []


def test_a_restarted_job_goes_on_after_the_last_id(app: ServedApp) -> None:
    job_id = app.job()
    app.begin(job_id)
    app.say(job_id, StateEvent(state=JobState.succeeded))
    first = follow(app, job_id)
    app.http.post(f"/v1/jobs/{job_id}/restart")
    app.begin(job_id)
    app.say(job_id, StateEvent(state=JobState.succeeded))
    second = follow(app, job_id, first[-1]["id"])
    assert brief(second) == ["queued", "preparing", "succeeded"]
    assert [e["attempt"] for e in second] == [0, 2, 2]
    assert brief(follow(app, job_id)) == ["queued", "preparing", "succeeded"]


def test_ids_and_jobs_that_are_not_ours_are_refused(app: ServedApp) -> None:
    job_id = app.job()
    for bad in ("7", "1-1_2-2", "x_y_z", "1-1_1-1_1", "1-1_1-1_" + "9" * 40):
        answer = app.http.get(f"/v1/jobs/{job_id}/events", headers={"Last-Event-ID": bad})
        problem(answer, 422, "cursor_invalid")
    problem(app.http.get("/v1/jobs/0123456789abcdef/events"), 404, "job_not_found")


def test_an_open_stream_does_not_hold_up_the_end_of_the_server(serve: Serve) -> None:
    app = serve()
    job_id = app.job()
    with app.http.stream("GET", f"/v1/jobs/{job_id}/events") as answer:
        stream = messages(answer.iter_lines())
        next(m for m in stream if "data" in m)
        app.service.closing.set()
        begun = time.monotonic()
        assert [m for m in stream if "data" in m] == []
        assert time.monotonic() - begun < 5


@pytest.mark.slow
def test_the_progress_stream_is_trimmed_and_the_states_are_not(app: ServedApp) -> None:
    job_id = app.job()
    app.begin(job_id)
    length = events.BOUNDS[keys.progress]
    assert length is not None
    for n in range(length + 500):
        app.say(job_id, ProgressEvent(stage="training", done=n), StateEvent(state=JobState.training))
    left = read_progress(app.redis, job_id)
    assert length <= len(left) < length + 200
    assert len(events.read_states(app.redis, job_id)) == length + 501
    latest = events.last_progress(app.redis, job_id)
    assert latest is not None
    assert latest.id == left[-1].id


def metric(step: int) -> MetricEvent:
    return MetricEvent(seconds=step, step=step, psnr=20.0, gaussians=10)


@pytest.mark.slow
def test_neither_progress_nor_a_talkative_log_pushes_out_warnings_and_the_curve(app: ServedApp) -> None:
    job_id = app.job()
    app.begin(job_id)
    app.say(job_id, LogEvent(level="warning", message="7.jpg is left out"), metric(1))
    for n in range(2 * max(bound for bound in events.BOUNDS.values() if bound)):
        app.say(job_id, LogEvent(message=f"line {n}"), ProgressEvent(stage="training", done=n))
    lines = app.http.get(f"/v1/jobs/{job_id}/logs?limit=10000").json()["lines"]
    assert lines[0]["message"] == "7.jpg is left out"
    assert lines[-1]["message"].startswith("line ")
    assert [row["step"] for row in app.http.get(f"/v1/jobs/{job_id}/curve").json()["rows"]] == [1]
    app.say(job_id, StateEvent(state=JobState.succeeded))
    words = brief(follow(app, job_id))
    assert words.count("metric") == 1


def test_the_curve_is_that_of_the_training_that_went_on(app: ServedApp) -> None:
    job_id = app.job()
    assert app.http.get(f"/v1/jobs/{job_id}/curve").json() == {"rows": []}
    app.begin(job_id)
    app.say(job_id, *map(metric, (10, 20, 30)))
    app.begin(job_id)  # resumes from a checkpoint at step 15
    app.say(job_id, *map(metric, (20, 40)))
    rows = app.http.get(f"/v1/jobs/{job_id}/curve").json()["rows"]
    assert [row["step"] for row in rows] == [10, 20, 40]
    assert rows[0]["psnr"] == 20.0
    problem(app.http.get("/v1/jobs/0123456789abcdef/curve"), 404, "job_not_found")


@pytest.mark.parametrize("end", ["failed", "cancelled", "succeeded"])
def test_the_log_of_an_ended_job_outlives_redis(app: ServedApp, end: str) -> None:
    job_id = app.job()
    app.begin(job_id)
    app.say(job_id, LogEvent(level="warning", message="7.jpg is left out: a\nb"), metric(1))
    if end == "cancelled":
        app.http.post(f"/v1/jobs/{job_id}/cancel")
    else:
        failure = Problem.of("diverged", "It diverged.") if end == "failed" else None
        app.say(job_id, StateEvent(state=JobState(end), problem=failure))
    app.service.reaper.tick()
    before = {name: app.http.get(f"/v1/jobs/{job_id}{name}").json() for name in ("", "/logs")}
    text = app.http.get(f"/v1/jobs/{job_id}/logs?format=text")
    app.redis.flushall()
    assert {name: app.http.get(f"/v1/jobs/{job_id}{name}").json() for name in ("", "/logs")} == before
    assert before["/logs"]["lines"][0]["message"] == "7.jpg is left out: a\nb"
    assert before[""]["state"] == end
    again = app.http.get(f"/v1/jobs/{job_id}/logs?format=text")
    assert again.text == text.text
    assert "Z  attempt 1  warning  7.jpg is left out: a\nb\n" in again.text
    assert again.headers["content-type"].startswith("text/plain")
    assert app.http.delete(f"/v1/jobs/{job_id}").status_code == 204
    problem(app.http.get(f"/v1/jobs/{job_id}/logs"), 404, "job_not_found")


def test_a_log_that_cannot_be_stored_is_stored_later(app: ServedApp) -> None:
    job_id = app.job()
    app.begin(job_id)
    assert app.service.storage.root is not None
    jobs = app.service.storage.root / "jobs"
    jobs.write_text("in the way")
    app.say(job_id, LogEvent(message="said"), StateEvent(state=JobState.failed))
    app.service.reaper.tick()
    jobs.unlink()
    app.service.reaper.tick()
    app.redis.flushall()
    assert [line["message"] for line in app.http.get(f"/v1/jobs/{job_id}/logs").json()["lines"]] == ["said"]


def test_logs_are_lines_of_all_attempts(app: ServedApp) -> None:
    job_id = app.job()
    for attempt in ("first", "second"):
        app.begin(job_id)
        app.say(job_id, LogEvent(message=attempt, level="warning"), ProgressEvent(stage="x"))
    lines = app.http.get(f"/v1/jobs/{job_id}/logs").json()["lines"]
    assert [(line["attempt"], line["message"]) for line in lines] == [(1, "first"), (2, "second")]
    assert [line["message"] for line in app.http.get(f"/v1/jobs/{job_id}/logs?limit=1").json()["lines"]] == [
        "second"
    ]
    problem(app.http.get("/v1/jobs/0123456789abcdef/logs"), 404, "job_not_found")
