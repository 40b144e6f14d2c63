"""The live view of a job over HTTP: who watches is written down for the worker, and what it shows is served.

The test plays the worker. Not proved here: what a worker shows (tests/worker/pipeline/test_live.py), and when
(tests/worker/service/attempts/test_live_view.py).
"""

import redis

from splatmill.backplane import keys
from splatmill.backplane.storage import layout
from splatmill.schema import CamerasEvent, JobState, Placement, SnapshotEvent, StateEvent
from splatmill_server.routes.jobs.live import WATCH_SECONDS
from tests.support.served_app import ServedApp, problem
from tests.support.servers.server_events import follow


def shown(connection: redis.Redis, job_id: str, ply: bytes, tag: str) -> None:
    """A snapshot as a worker leaves it."""
    connection.hset(keys.snapshot(job_id), mapping={"ply": ply, "tag": tag})


def test_a_request_to_watch_is_there_for_the_worker_for_some_seconds(app: ServedApp) -> None:
    job_id = app.job()
    assert not app.redis.exists(keys.watched(job_id))
    answer = app.http.post(f"/v1/jobs/{job_id}/watch")
    assert answer.json() == {"seconds": WATCH_SECONDS}
    assert WATCH_SECONDS - 5 < app.redis.ttl(keys.watched(job_id)) <= WATCH_SECONDS
    app.redis.pexpire(keys.watched(job_id), 100)
    app.http.post(f"/v1/jobs/{job_id}/watch")
    assert app.redis.ttl(keys.watched(job_id)) > 5, "asking again prolongs it"


def test_a_job_that_has_ended_is_not_watched(app: ServedApp) -> None:
    job_id = app.job()
    app.begin(job_id)
    app.finish(job_id)
    assert app.http.post(f"/v1/jobs/{job_id}/watch").raise_for_status().json() == {"seconds": 0}
    assert not app.redis.exists(keys.watched(job_id))


def test_a_snapshot_is_served_once_for_each_tag(app: ServedApp) -> None:
    job_id = app.job()
    app.begin(job_id)
    address = f"/v1/jobs/{job_id}/snapshot"
    assert "watch" in problem(app.http.get(address), 404, "snapshot_not_ready")["advice"]
    shown(app.redis, job_id, b"ply \x00\xff 1", "1-40")
    first = app.http.get(address)
    assert (first.content, first.headers["etag"]) == (b"ply \x00\xff 1", '"1-40"')
    again = app.http.get(address, headers={"If-None-Match": first.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    shown(app.redis, job_id, b"ply 2", "1-90")
    newer = app.http.get(address, headers={"If-None-Match": first.headers["etag"]})
    assert (newer.status_code, newer.content) == (200, b"ply 2")
    app.finish(job_id)
    assert app.http.delete(f"/v1/jobs/{job_id}").status_code == 204
    assert not app.redis.exists(keys.snapshot(job_id))


def test_cameras_are_served_as_they_are_placed(app: ServedApp) -> None:
    job_id = app.job()
    app.begin(job_id)
    address = app.http.get(f"/v1/jobs/{job_id}").json()["links"]["cameras"]
    problem(app.http.get(address), 404, "cameras_not_ready")
    document = Placement(
        final=False, cameras=[], points=[(1.0, 2.0, 3.0)], colors=[], points_total=1, unused=[]
    )
    app.service.storage.put(layout.job_cameras(job_id), document.model_dump_json(exclude_none=True).encode())
    answer = app.http.get(address)
    assert Placement.model_validate(answer.json()) == document
    assert app.http.get(address, headers={"If-None-Match": answer.headers["etag"]}).status_code == 304


def test_both_events_reach_clients(app: ServedApp) -> None:
    job_id = app.job()
    app.begin(job_id)
    app.say(job_id, StateEvent(state=JobState.sfm))
    app.say(job_id, CamerasEvent(path=layout.job_cameras(job_id), cameras=3, points=90, final=True))
    app.say(job_id, StateEvent(state=JobState.training))
    app.say(job_id, SnapshotEvent(step=40, seconds=1.5, gaussians=90, shown=90, bytes=1440))
    app.finish(job_id)
    events = [event["event"] for event in follow(app, job_id)]
    assert [event["type"] for event in events if event["type"] != "state"] == ["cameras", "snapshot"]
    assert [event["step"] for event in events if event["type"] == "snapshot"] == [40]
    assert [event["final"] for event in events if event["type"] == "cameras"] == [True]
