"""A Redis that comes back empty is filled from storage: jobs wait again, ended ones are as they were.

Not proved here: that a worker takes its lease again (tests/worker/service/test_rejoin), and both together with real
processes (tests/service/test_kills).
"""

import json
from collections.abc import Callable, Sequence
from typing import Any

import pytest
import redis

from splatmill.backplane import keys, lists
from splatmill.backplane.jobs import row
from splatmill.backplane.queue import entries, leases, queue
from splatmill.backplane.storage import layout
from splatmill.schema import (
    CreateJob,
    JobState,
    KeyLimits,
    LogEvent,
    MetricEvent,
    PlanEvent,
    Problem,
    ProgressEvent,
    StateEvent,
)
from splatmill_server.access.caller import Caller
from splatmill_server.base.problems import ProblemError
from splatmill_server.jobs import log as job_log
from splatmill_server.jobs import restoring
from tests.support.served_app import ServedApp, problem
from tests.support.servers.queue_entries import take, waiting
from tests.support.servers.server_events import brief, follow


def listed(app: ServedApp, path: str = "/v1/jobs") -> dict[str, Any]:
    name = path.partition("?")[0].rpartition("/")[2]
    return {record["id"]: record for record in app.http.get(path).json()[name]}


def emptied(app: ServedApp) -> None:
    """Redis loses everything, and the reaper looks."""
    app.redis.flushall()
    app.service.reaper.tick()


def grace_over(app: ServedApp) -> None:
    """The time in which workers take their leases again has passed, and the reaper looks."""
    assert 0 < app.redis.ttl(keys.RESTORED) <= leases.LEASE
    app.redis.delete(keys.RESTORED)
    app.service.reaper.tick()


def test_queued_jobs_wait_again_when_no_worker_claims_them(app: ServedApp) -> None:
    jobs = [app.job() for _ in range(3)]
    before = listed(app)
    emptied(app)
    after = listed(app)
    assert set(after) == set(jobs)
    assert waiting(app.redis) == 0, "a worker that runs one of them has time to say so"
    assert 0 < app.service.reaper.pause <= leases.LEASE + 0.01, "it looks again when that time is over"
    grace_over(app)
    assert app.service.reaper.pause == app.service.reaper.interval
    assert waiting(app.redis) == 3
    assert listed(app) == before


def test_restored_jobs_wait_no_longer_where_the_clock_of_redis_is_set_back(app: ServedApp) -> None:
    app.job()
    emptied(app)
    app.redis.expire(keys.RESTORED, 1800)  # as seen after half an hour back
    app.service.reaper.tick()
    grace_over(app)
    assert waiting(app.redis) == 1


def test_ended_jobs_are_as_they_were(app: ServedApp) -> None:
    capture_id = app.capture()
    ends = [JobState.succeeded, JobState.failed, JobState.cancelled]
    jobs = [app.job(capture_id) for _ in ends]
    for job_id, end in zip(jobs, ends, strict=True):
        app.begin(job_id)
        app.say(
            job_id, StateEvent(state=JobState.training), PlanEvent(plan={"sh": 3}), LogEvent(message="said")
        )
        app.say(job_id, ProgressEvent(stage="training", done=3))
        app.say(job_id, MetricEvent(seconds=1, step=3, psnr=20.0, gaussians=5))
        if end is JobState.succeeded:
            app.finish(job_id)
        elif end is JobState.failed:
            app.say(job_id, StateEvent(state=end, problem=Problem.of("diverged", "It diverged.")))
        else:
            app.http.post(f"/v1/jobs/{job_id}/cancel")
    app.service.reaper.tick()
    paths = [f"/v1/jobs/{job_id}{name}" for job_id in jobs for name in ("", "/logs", "/curve")]
    before, models = [app.http.get(path).json() for path in paths], listed(app, "/v1/models")
    order = list(listed(app))
    emptied(app)
    assert [app.http.get(path).json() for path in paths] == before
    assert list(listed(app)) == order
    assert listed(app, "/v1/models") == models
    assert list(listed(app, "/v1/captures")) == [capture_id]
    for job_id, end in zip(jobs, ends, strict=True):
        assert list(listed(app, f"/v1/jobs?state={end}")) == [job_id]
        assert brief(follow(app, job_id))[-1] == end
        again = app.http.post(f"/v1/jobs/{job_id}/restart")
        assert (again.status_code, again.json()["state"]) == (202, "queued")
        job_row = row.read(app.redis, job_id)
        assert job_row is not None
        assert job_row.generation == 2
    assert not any(app.redis.sismember(keys.RESTORED, job_id) for job_id in jobs)


def test_a_job_that_a_worker_still_runs_is_neither_queued_nor_called_cancelled(app: ServedApp) -> None:
    job_id = app.job()
    lease = take(app.redis)
    entry = entries.QueueEntry.fetch(lease.entry, connection=app.redis, serializer=entries.SERIALIZER)
    emptied(app)
    answer = app.http.post(f"/v1/jobs/{job_id}/cancel").json()
    assert (answer["state"], answer["cancel_requested"]) == ("queued", True)
    # Its worker says that it runs: the queue knows it, and the worker is asked to stop.
    assert leases.rejoin(app.redis, lease, "worker", entry.to_dict(include_meta=False))
    app.redis.delete(keys.RESTORED)
    app.service.reaper.tick()
    assert queue.status(app.redis, job_id, 1).state == "running"
    assert app.state(job_id) == "queued"


def test_a_deleted_job_does_not_come_back(app: ServedApp) -> None:
    kept, gone = app.job(), app.job()
    for job_id in (kept, gone):
        app.begin(job_id)
        app.finish(job_id)
    app.service.reaper.tick()
    app.http.delete(f"/v1/jobs/{gone}")
    emptied(app)
    assert set(listed(app)) == set(listed(app, "/v1/models")) == {kept}
    assert not any(gone in entry.path for entry in app.service.storage.walk(""))


def test_a_job_that_ended_is_not_begun_again_where_its_request_was_left(app: ServedApp) -> None:
    job_id = app.job()
    request = app.service.storage.get(layout.unfinished_job(job_id))
    app.begin(job_id)
    app.say(job_id, StateEvent(state=JobState.failed))
    app.service.reaper.tick()
    assert not app.service.storage.exists(layout.unfinished_job(job_id))
    app.service.storage.put(layout.unfinished_job(job_id), request)
    emptied(app)
    assert app.state(job_id) == "failed"
    assert not app.service.storage.exists(layout.unfinished_job(job_id))
    # Its second generation has not ended.
    app.http.post(f"/v1/jobs/{job_id}/restart").raise_for_status()
    emptied(app)
    assert app.state(job_id) == "queued"
    job_row = row.read(app.redis, job_id)
    assert job_row is not None
    assert job_row.generation == 2


def test_a_single_lost_row_is_restored_at_the_second_look(app: ServedApp) -> None:
    job_id = app.job()
    app.redis.delete(keys.job(job_id))
    reaper = app.service.reaper
    for expected in (False, True):
        reaper._looked_at = float("-inf")
        reaper.tick()
        assert bool(app.redis.exists(keys.job(job_id))) is expected
    assert app.state(job_id) == "queued"


def test_a_lost_row_is_restored_for_whoever_asks_for_its_job(app: ServedApp) -> None:
    job_id, cancelled = app.job(), app.job()
    before = app.http.get(f"/v1/jobs/{job_id}").json()
    app.redis.delete(keys.job(job_id), keys.job(cancelled))
    with pytest.raises(ProblemError, match="no job"):
        app.service.jobs.check_visible(Caller("another", scopes=frozenset()), job_id)
    assert app.http.get(f"/v1/jobs/{job_id}").json() == before
    app.redis.delete(keys.job(job_id))
    assert app.http.get(f"/v1/jobs/{job_id}").json() == before
    assert app.http.post(f"/v1/jobs/{cancelled}/cancel").status_code == 202
    assert app.http.get("/v1/jobs/0123456789abcdef").status_code == 404


def test_a_refused_job_leaves_no_request(app: ServedApp) -> None:
    asked = CreateJob(capture=app.capture())
    with pytest.raises(ProblemError, match="permits 0 at once"):
        app.service.admission.create(Caller("default", limits=KeyLimits(unfinished_jobs=0)), asked)
    assert list(app.service.storage.walk(layout.unfinished_jobs())) == []


def test_those_who_ask_while_lists_are_made_are_told_to_come_again(
    app: ServedApp, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("splatmill_server.base.lists.LONGEST_WAIT", 0.0)
    job_id = app.job()
    app.redis.delete(keys.LISTED)
    app.redis.set(keys.LISTING, "another process", ex=1800)  # as seen after the clock of Redis was set back
    for path in ("/v1/jobs", "/v1/captures", "/v1/models"):
        answer = app.http.get(path)
        assert problem(answer, 503, "lists_not_ready")["advice"]
        assert answer.headers["retry-after"]
    assert app.state(job_id) == "queued"
    assert 0 < app.redis.ttl(keys.LISTING) <= 30
    app.redis.delete(keys.LISTING)
    assert list(listed(app)) == [job_id]
    assert app.redis.get(keys.LISTED) == lists.VERSION


def test_a_cancelled_job_stays_cancelled_where_redis_comes_back_empty_at_once(app: ServedApp) -> None:
    job_id = app.job()
    app.http.post(f"/v1/jobs/{job_id}/cancel")
    app.service.reaper.tick()
    app.redis.flushall()
    app.service.reaper.tick()
    assert app.state(job_id) == "cancelled"


@pytest.mark.parametrize("stored", [layout.job_log, layout.job_curve])
def test_a_redis_that_is_emptied_while_the_end_of_a_job_is_stored_loses_nothing(
    app: ServedApp, monkeypatch: pytest.MonkeyPatch, stored: Callable[[str], str]
) -> None:
    job_id = app.job()
    app.begin(job_id)
    app.say(
        job_id, MetricEvent(step=5, seconds=1.0, psnr=20.0, gaussians=7), StateEvent(state=JobState.failed)
    )
    put = app.service.storage.put

    def emptied_put(path: str, data: bytes) -> None:
        put(path, data)
        if path == stored(job_id):
            app.redis.flushall()

    monkeypatch.setattr(app.service.storage, "put", emptied_put)
    app.service.reaper.tick()
    monkeypatch.undo()
    app.service.reaper.tick()
    assert app.service.storage.exists(stored(job_id))
    assert app.state(job_id) == "failed"


def test_a_job_that_is_deleted_while_its_end_is_stored_leaves_nothing(app: ServedApp) -> None:
    job_id = app.job()
    app.begin(job_id)
    app.say(job_id, StateEvent(state=JobState.failed))
    app.service.reaper.tick()
    job = app.service.jobs.get(job_id)
    app.service.deletion.job(job_id)
    job_log.save(app.redis, app.service.storage, job, 1)
    assert list(app.service.storage.entries(layout.job(job_id))) == []
    problem(app.http.get(f"/v1/jobs/{job_id}"), 404, "job_not_found")


def test_a_row_that_is_inserted_while_it_is_restored_stays(
    app: ServedApp, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id, other = app.job(), app.capture()
    inserted: Any = app.redis.hgetall(keys.job(job_id))
    stored = json.loads(app.service.storage.get(layout.unfinished_job(job_id)))
    changed = json.dumps(stored | {"capture": other}).encode()
    app.service.storage.put(layout.unfinished_job(job_id), changed)
    app.redis.delete(keys.job(job_id))
    without_row = restoring.without_row

    def late(connection: redis.Redis, job_ids: Sequence[str]) -> list[str]:
        missing = without_row(connection, job_ids)
        app.redis.hset(keys.job(job_id), mapping=inserted)
        return missing

    monkeypatch.setattr(restoring, "without_row", late)
    app.service.jobs.restore([job_id])
    assert app.http.get(f"/v1/jobs/{job_id}").json()["capture"] == stored["capture"]
