"""Redis stops, and comes back empty: what is stored is still served, and the next request works.

Not proved here: a Redis that comes back with its log (tests/service does that with the whole service).
"""

from pathlib import Path

import pytest

from splatmill.backplane import lists
from splatmill.backplane.connection import connect
from splatmill.backplane.storage import layout
from splatmill_server.access.sessions import COOKIE
from tests.support.redis_server import RedisServer, empty_redis
from tests.support.served_app import Serve, ServedApp, problem, served_app, store_model
from tests.support.servers.server_events import brief, follow

pytestmark = pytest.mark.slow

MODEL = "a" * 16


def test_stored_things_outlast_redis(serve: Serve, tmp_path: Path) -> None:
    folder = tmp_path / "r"
    with empty_redis(folder) as url:
        settings = serve(redis_url=url).settings
        client = connect(url)
        with served_app(settings, client) as app:
            store_model(app.service, MODEL, "fox")
            capture_id = app.capture()
            waiting = app.job(capture_id)
            app.redis = client
    with served_app(settings, client) as app:
        answer = app.http.post("/v1/jobs", json={"capture": capture_id})
        assert problem(answer, 503, "queue_unavailable")["advice"]
        assert answer.headers["retry-after"]
        problem(app.http.get("/v1/jobs"), 503, "queue_unavailable")
        ready = app.http.get("/readyz")
        assert (ready.status_code, ready.json()["ready"]) == (503, False)
        assert ready.json()["checks"]["storage"] == "ok"
        # Anybody may ask, so that it names no address.
        assert (
            ready.json()["checks"]["redis"] == "Redis cannot be reached; the log of the server has the reason"
        )
        assert app.http.get("/healthz").status_code == 200
        assert "splatmill_redis_up 0.0" in app.http.get("/metrics").text
        problem(app.http.get("/v1/models"), 503, "queue_unavailable")
        # Nothing of these needs Redis.
        assert app.http.get(f"/v1/models/{MODEL}").json()["id"] == MODEL
        assert app.http.get(f"/v1/models/{MODEL}/files/model.ply").status_code == 200
        assert app.http.get(f"/v1/captures/{capture_id}").json()["id"] == capture_id
        put = app.http.put(f"/v1/captures/{capture_id}/images/c.jpg", content=b"c")
        assert put.status_code == 201
        with empty_redis(folder):
            check_after_return(app, capture_id, waiting)
    client.close()


def test_only_callers_with_a_key_read_what_redis_says(serve: Serve, tmp_path: Path) -> None:
    app = serve(api_key="s3cret", redis_url=f"unix://{tmp_path}/secret-place.sock")
    detail = problem(app.http.get("/v1/jobs"), 503, "queue_unavailable")["detail"]
    assert "secret-place" in detail
    stranger = {"Authorization": "none", "Cookie": f"{COOKIE}=of-anybody"}
    for path in ("/v1/jobs", "/readyz"):
        assert "secret-place" not in app.http.get(path, headers=stranger).text
    detail = problem(app.http.get("/v1/jobs", headers=stranger), 503, "queue_unavailable")["detail"]
    assert "the log of the server has the reason" in detail


def check_after_return(app: ServedApp, capture_id: str, waiting: str) -> None:
    """The same address, an empty Redis: the server needs no restart, and its lists are made from storage."""
    assert app.http.get("/readyz").status_code == 200
    assert [(job["id"], job["state"]) for job in app.http.get("/v1/jobs").json()["jobs"]] == [
        (waiting, "queued")
    ]
    assert [model["id"] for model in app.http.get("/v1/models").json()["models"]] == [MODEL]
    assert [capture["id"] for capture in app.http.get("/v1/captures").json()["captures"]] == [capture_id]
    job = app.http.get(f"/v1/jobs/{MODEL}").json()
    assert (job["state"], job["name"], job["model"]) == ("succeeded", "fox", MODEL)
    assert brief(follow(app, MODEL)) == ["succeeded"]
    assert app.state(app.job(capture_id)) == "queued"
    assert app.http.delete(f"/v1/jobs/{MODEL}").status_code == 204
    assert not app.service.storage.exists(layout.model_file(MODEL, "model.ply"))


def test_a_request_that_redis_refuses_is_answered_with_the_cause(app: ServedApp) -> None:
    job_id = app.job()
    app.redis.config_set("min-replicas-to-write", 1)
    try:
        answer = problem(app.http.post(f"/v1/jobs/{job_id}/cancel"), 503, "queue_unavailable")
        assert "NOREPLICAS" in answer["detail"]
        assert app.http.get(f"/v1/jobs/{job_id}").json()["state"] == "queued"
    finally:
        app.redis.config_set("min-replicas-to-write", 0)
    assert app.http.post(f"/v1/jobs/{job_id}/cancel").json()["state"] == "cancelled"


def test_what_redis_has_lost_of_its_lists_is_listed_again(serve: Serve, tmp_path: Path) -> None:
    """A Redis that is killed loses its last second of writes, and a capture can be made while it refuses writes."""
    server = RedisServer(tmp_path)
    server.start()
    app = serve(redis_url=server.url)

    def listed(what: str) -> list[str]:
        return [record["id"] for record in app.http.get(f"/v1/{what}").json()[what]]

    try:
        capture = app.capture()
        store_model(app.service, MODEL)
        assert (listed("captures"), listed("models")) == ([capture], [MODEL])
        assert app.service.relisting.look() == 0
        server.connection.zrem(lists.name("captures"), capture)
        server.connection.zrem(lists.name("models"), MODEL)
        assert app.service.relisting.look() == 0, "this Redis was compared with storage"
        server.kill()
        server.start()
        assert (listed("captures"), listed("models")) == ([], [])
        assert app.service.relisting.look() == 2
        assert (listed("captures"), listed("models")) == ([capture], [MODEL])

        server.connection.config_set("min-replicas-to-write", 1)
        other = str(app.http.post("/v1/captures", json={}).json()["id"])
        server.connection.config_set("min-replicas-to-write", 0)
        assert listed("captures") == [capture]
        assert app.service.relisting.look() == 1
        assert listed("captures") == [other, capture]
    finally:
        server.connection.close()
        server.kill()
