"""The limits of a key: requests a minute, over all API processes, and unfinished jobs at once.

Not proved here: bytes in storage, and that the SDK waits (tests/client/transfer/test_connection.py).
"""

import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import pytest

from splatmill.backplane import keys
from splatmill.backplane.connection import connect_async
from splatmill.sdk.client import Client
from splatmill_server.access.rate import Rate
from tests.support.served_app import Serve, ServedApp, problem

pytestmark = pytest.mark.slow  # a server for each case


def key(app: ServedApp, owner: str, **limits: int) -> dict[str, Any]:
    answer = app.http.post("/v1/keys", json={"name": f"{owner}'s key", "owner": owner, "limits": limits})
    assert answer.status_code == 201, answer.text
    return dict(answer.json())


def bearer(made: dict[str, Any]) -> dict[str, str]:
    return {"Authorization": f"Bearer {made['secret']}"}


@pytest.fixture
def app(serve: Serve) -> ServedApp:
    return serve(api_key="s3cret")


def test_a_minute_of_requests_is_shared_by_all_api_processes(serve: Serve, app: ServedApp) -> None:
    ann, bob = key(app, "ann", requests_per_minute=6), key(app, "bob", requests_per_minute=6)
    other = serve(api_key="s3cret")
    answers = [at.http.get("/v1/me", headers=bearer(ann)) for at in (app, other) for _ in range(4)]
    assert [answer.status_code for answer in answers] == [200] * 6 + [429] * 2
    refusal = problem(answers[-1], 429, "too_many_requests")
    # Six a minute are one in ten seconds.
    assert 1 <= int(answers[-1].headers["retry-after"]) <= 10
    assert refusal["facts"]["requests_per_minute"] == 6
    assert app.http.get("/v1/me", headers=bearer(bob)).status_code == 200
    assert app.http.get("/v1/me").status_code == 200
    assert app.http.get("/healthz", headers=bearer(ann)).status_code == 200


def test_the_bucket_fills_evenly(app: ServedApp) -> None:
    ann = key(app, "ann", requests_per_minute=60)
    name = keys.rate(ann["id"])
    seconds, microseconds = app.redis.time()
    # The bucket will be full in 58.5 s: there is room for one request, not for two.
    app.redis.set(name, str(seconds * 1000 + microseconds / 1000 + 58_500))
    statuses = [app.http.get("/v1/me", headers=bearer(ann)).status_code for _ in range(2)]
    assert statuses == [200, 429]
    assert 0 < app.redis.pttl(name) <= 120_000


def test_without_redis_requests_that_need_none_go_on(app: ServedApp) -> None:
    ann = key(app, "ann", requests_per_minute=1)
    middleware: Any = app.asgi.middleware_stack
    while not hasattr(middleware, "rate"):
        middleware = middleware.app
    middleware.rate = Rate(connect_async("unix:///nowhere/redis.sock"))
    assert [app.http.get("/v1/models", headers=bearer(ann)).status_code for _ in range(3)] == [200] * 3


def test_the_sdk_waits_as_long_as_it_is_told(app: ServedApp) -> None:
    ann = key(app, "ann", requests_per_minute=60)
    seconds, microseconds = app.redis.time()
    # There is room for the next request in 0.9 s, which Retry-After rounds up.
    app.redis.set(keys.rate(ann["id"]), str(seconds * 1000 + microseconds / 1000 + 59_900))
    begun = time.monotonic()
    with Client(str(app.http.base_url), api_key=ann["secret"], retries=1) as client:
        assert client.me().owner == "ann"
    assert time.monotonic() - begun >= 0.9


def post_job(app: ServedApp, made: dict[str, Any], capture: str, **headers: str) -> httpx.Response:
    return app.http.post("/v1/jobs", json={"capture": capture}, headers=bearer(made) | headers)


@pytest.fixture
def ann(app: ServedApp) -> dict[str, Any]:
    return key(app, "ann", unfinished_jobs=2)


@pytest.fixture
def capture(app: ServedApp, ann: dict[str, Any]) -> str:
    made = app.http.post("/v1/captures", json={}, headers=bearer(ann)).json()["id"]
    for name in ("a.jpg", "b.jpg"):
        app.http.put(f"/v1/captures/{made}/images/{name}", content=name.encode(), headers=bearer(ann))
    return str(made)


def test_unfinished_jobs_are_counted_and_named(app: ServedApp, ann: dict[str, Any], capture: str) -> None:
    app.job()  # of another owner, which does not count
    first, second = (post_job(app, ann, capture).json()["id"] for _ in range(2))
    refused = post_job(app, ann, capture, **{"Idempotency-Key": "third"})
    refusal = problem(refused, 429, "too_many_jobs")
    assert refusal["facts"] == {"unfinished_jobs": 2, "limit": 2}
    assert "2 unfinished jobs" in refusal["detail"]
    form: dict[str, Any] = {"files": [("images", (f"{n}.jpg", b"photo %d" % n)) for n in range(2)]}
    problem(app.http.post("/v1/jobs", headers=bearer(ann), **form), 429, "too_many_jobs")
    captures = app.http.get("/v1/captures", headers=bearer(ann)).json()["captures"]
    assert [entry["id"] for entry in captures] == [capture]
    assert app.http.get("/v1/me", headers=bearer(ann)).json()["use"]["unfinished_jobs"] == 2
    assert app.http.post(f"/v1/jobs/{first}/cancel", headers=bearer(ann)).json()["state"] == "cancelled"
    third = post_job(app, ann, capture, **{"Idempotency-Key": "third"})
    assert third.status_code == 202
    # A repeated request is not another job, and a restarted one is.
    assert post_job(app, ann, capture, **{"Idempotency-Key": "third"}).json()["id"] == third.json()["id"]
    problem(app.http.post(f"/v1/jobs/{first}/restart", headers=bearer(ann)), 429, "too_many_jobs")
    app.begin(second)
    app.finish(second)
    assert app.http.post(f"/v1/jobs/{first}/restart", headers=bearer(ann)).json()["state"] == "queued"


def test_requests_at_once_do_not_get_past_the_limit(
    app: ServedApp, ann: dict[str, Any], capture: str
) -> None:
    with ThreadPoolExecutor(12) as pool:
        answers = list(pool.map(lambda _: post_job(app, ann, capture).status_code, range(12)))
    assert sorted(answers) == [202] * 2 + [429] * 10
