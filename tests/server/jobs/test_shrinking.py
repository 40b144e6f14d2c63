"""What Redis keeps of a job that has ended: little, and everything that clients ask for is answered as before.

Not proved here: that the reaper looks often enough (its interval is a setting), and the events before (test_events).
"""

from typing import Any

import pytest
import redis

from splatmill.backplane import keys
from splatmill.backplane.jobs import events, row
from splatmill.backplane.jobs.events import LATEST
from splatmill.schema import (
    JobState,
    LogEvent,
    MetricEvent,
    PlanEvent,
    PreviewEvent,
    Problem,
    ProgressEvent,
    StateEvent,
)
from splatmill_server.jobs import shrinking
from tests.support.served_app import ServedApp
from tests.support.servers.server_events import brief, follow

LIMIT = 10_000
"""Bytes that an ended job may hold in Redis."""


def bytes_of(connection: redis.Redis, job_id: str) -> int:
    """Bytes of all keys that are named after a job, RQ's among them."""
    names: Any = [key for key in connection.keys("*") if job_id.encode() in key]
    return sum(int(connection.memory_usage(name, samples=0) or 0) for name in names)


def shrink(app: ServedApp, job_id: str) -> None:
    """The reaper sees the end of a job, and looks again when its time has come."""
    app.service.reaper.tick()
    due = app.redis.zscore(keys.UNSHRUNK, job_id)
    assert due is not None
    assert due / 1000 - app.redis.time()[0] > shrinking.WHOLE_SECONDS - 10
    app.redis.zadd(keys.UNSHRUNK, {job_id: 0})
    app.service.reaper.tick()


def talk(app: ServedApp, job_id: str, count: int) -> None:
    """Say as much as a long training does."""
    for number in range(count):
        app.say(
            job_id,
            ProgressEvent(stage="training", done=number, total=count, psnr=20.0),
            LogEvent(message=f"line {number} of a log with some words in it"),
            MetricEvent(seconds=number, step=number, psnr=20.0, gaussians=1000),
        )


def answers(app: ServedApp, job_id: str) -> dict[str, Any]:
    """What clients can ask of a job."""
    responses = {
        name: app.http.get(f"/v1/jobs/{job_id}{name}") for name in ("", "/logs", "/curve", "/preview")
    }
    return {name: answer.content for name, answer in responses.items()} | {
        "listed": app.http.get("/v1/jobs").json()["jobs"]
    }


@pytest.mark.parametrize("end", ["succeeded", "failed", "cancelled"])
def test_an_ended_job_holds_little_and_answers_as_before(app: ServedApp, end: str) -> None:
    job_id = app.job()
    app.begin(job_id)
    plan = {f"decision_{n}": {"value": n, "reason": "as long as a reason is" * 2} for n in range(30)}
    app.say(job_id, StateEvent(state=JobState.training), PlanEvent(plan=plan))
    talk(app, job_id, 300)
    if end == "succeeded":
        app.finish(job_id)
    elif end == "failed":
        app.say(job_id, StateEvent(state=JobState.failed, problem=Problem.of("diverged", "It diverged.")))
    else:
        app.http.post(f"/v1/jobs/{job_id}/cancel")
    before = answers(app, job_id)
    assert bytes_of(app.redis, job_id) > LIMIT
    shrink(app, job_id)
    assert bytes_of(app.redis, job_id) < LIMIT
    assert answers(app, job_id) == before
    assert len(app.http.get(f"/v1/jobs/{job_id}/curve").json()["rows"]) == 300
    assert app.redis.zcard(keys.UNSHRUNK) == 0


def test_those_who_follow_the_events_keep_their_place(app: ServedApp) -> None:
    job_id = app.job()
    app.begin(job_id)
    talk(app, job_id, 3)
    app.say(job_id, StateEvent(state=JobState.succeeded))
    whole = follow(app, job_id)
    shrink(app, job_id)
    left = [told for told in whole if told["event"]["type"] == "state"]
    assert [told["event"] for told in follow(app, job_id)] == [told["event"] for told in left]
    for told in whole[:-1]:
        assert brief(follow(app, job_id, told["id"]))[-1] == "succeeded"


def test_the_log_and_curve_of_a_restarted_job_begin_with_those_from_before(app: ServedApp) -> None:
    job_id = app.job()
    for step, said in ((10, "first"), (20, "second"), (30, "third")):
        app.begin(job_id)
        app.say(job_id, LogEvent(message=said), MetricEvent(seconds=1, step=step, psnr=9.0, gaussians=1))
        app.say(job_id, StateEvent(state=JobState.failed))
        app.service.reaper.tick()
        app.redis.sadd(keys.ACTIVE, job_id)  # another process sees the end as well, and stores it again
        shrink(app, job_id)
        app.http.post(f"/v1/jobs/{job_id}/restart").raise_for_status()
    lines = app.http.get(f"/v1/jobs/{job_id}/logs").json()["lines"]
    assert [line["message"] for line in lines] == ["first", "second", "third"]
    rows = app.http.get(f"/v1/jobs/{job_id}/curve").json()["rows"]
    assert [point["step"] for point in rows] == [10, 20, 30]
    assert app.state(job_id) == "queued"


def test_a_job_that_was_restarted_meanwhile_keeps_its_streams(app: ServedApp) -> None:
    job_id = app.job()
    app.begin(job_id)
    app.say(job_id, LogEvent(message="said"), StateEvent(state=JobState.failed))
    app.http.post(f"/v1/jobs/{job_id}/restart").raise_for_status()
    shrinking.shrink(app.redis, job_id)
    assert len(events.read_log(app.redis, job_id)) == 1
    assert not app.redis.hexists(keys.latest(job_id), keys.SHRUNK)


def test_the_states_of_a_hundred_attempts_shrink_to_what_tells_the_job(app: ServedApp) -> None:
    job_id = app.job()
    for _ in range(100):
        app.begin(job_id)
        app.say(job_id, StateEvent(state=JobState.training), PlanEvent(plan={"a": "b" * 100}))
    app.say(job_id, StateEvent(state=JobState.succeeded))
    before = app.http.get(f"/v1/jobs/{job_id}").json()
    shrink(app, job_id)
    assert app.http.get(f"/v1/jobs/{job_id}").json() == before
    assert len(events.read_states(app.redis, job_id)) == 5
    assert bytes_of(app.redis, job_id) < LIMIT


def test_progress_and_preview_are_read_without_their_stream(app: ServedApp) -> None:
    job_id = app.job()
    app.begin(job_id)
    app.say(job_id, ProgressEvent(stage="training", done=7), PreviewEvent(path="previews/1.jpg", step=7))
    app.redis.delete(keys.progress(job_id))
    latest = events.last_progress(app.redis, job_id)
    assert latest is not None
    assert latest.event == ProgressEvent(stage="training", done=7)
    preview = events.last_preview(app.redis, job_id)
    assert preview is not None
    assert preview.path == "previews/1.jpg"
    # A field of a later version is left out like an event of one.
    app.redis.hset(keys.latest(job_id), LATEST[ProgressEvent], "nonsense")
    assert events.last_progress(app.redis, job_id) is None
    assert row.read(app.redis, job_id) is not None
