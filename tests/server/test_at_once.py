"""Limits by number hold for requests that come at the same moment, on two API processes.

Not proved here: the quota of bytes (tests/server/space/test_reservations), and the number of unfinished jobs
(tests/server/access/test_limits).
"""

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import pytest

from splatmill.backplane.storage.storage import StorageError
from splatmill_server import shares, webhooks
from splatmill_server.background import imports, orbits
from splatmill_server.base.metrics import Metrics
from tests.support.served_app import Serve, ServedApp, store_model
from tests.support.servers.scripted_server import Reply, ScriptedServer, scripted_server

pytestmark = pytest.mark.slow

MODEL = "a" * 16
AT_ONCE = 8

Ask = Callable[[httpx.Client, int], httpx.Response]


def statuses(apps: list[ServedApp], ask: Ask) -> Counter[int]:
    """The statuses of AT_ONCE requests that begin together, each on a connection of its own that is open already."""
    together = threading.Barrier(AT_ONCE)

    def one(number: int) -> int:
        app = apps[number % len(apps)]
        with httpx.Client(
            base_url=app.http.base_url, headers=app.http.headers, timeout=60, trust_env=False, verify=False
        ) as http:
            http.get("/healthz")
            together.wait(60)
            return ask(http, number).status_code

    with ThreadPoolExecutor(AT_ONCE) as pool:
        return Counter(pool.map(one, range(AT_ONCE)))


@pytest.fixture
def peer() -> Iterator[ScriptedServer]:
    """A server that answers to nobody before the test has ended."""
    with scripted_server() as server:
        server.answer = lambda _: Reply(status=503)
        yield server


@pytest.fixture
def slow_lists(monkeypatch: pytest.MonkeyPatch) -> None:
    """Storage that takes a moment for each list, as a bucket does: requests that count by it all see the same."""
    told = Metrics.storage_operation

    def later(self: Metrics, verb: str, seconds: float, error: StorageError | None) -> None:
        told(self, verb, seconds, error)
        if verb == "list":
            time.sleep(0.1)

    monkeypatch.setattr(Metrics, "storage_operation", later)


@pytest.fixture
def apps(
    slow_lists: None, serve: Serve, peer: ScriptedServer, monkeypatch: pytest.MonkeyPatch
) -> list[ServedApp]:
    monkeypatch.setattr(imports, "_PAUSE_SECONDS", 3600.0)
    # Nothing listens at the address of the renderer, so that videos wait.
    settings: dict[str, Any] = {
        "outgoing_allow": peer.url.removeprefix("http://"),
        "renderer_url": "http://127.0.0.1:1",
    }
    pair = [serve(**settings), serve(**settings)]
    store_model(pair[0].service, MODEL)
    return pair


def test_links_to_a_model(apps: list[ServedApp], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shares, "MAX_SHARES", 3)
    path = f"/v1/models/{MODEL}/shares"
    assert statuses(apps, lambda http, _: http.post(path, json={})) == {201: 3, 429: AT_ONCE - 3}
    assert len(apps[0].http.get(path).json()["shares"]) == 3


@pytest.mark.parametrize("limit", ["MAX_UNFINISHED", "MAX_OF_OWNER"])
def test_imports_that_have_not_ended(
    apps: list[ServedApp], peer: ScriptedServer, limit: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(imports, limit, 3)
    captures = [apps[0].capture(), apps[0].capture()]

    def ask(http: httpx.Client, number: int) -> httpx.Response:
        capture = captures[0 if limit == "MAX_UNFINISHED" else number % 2]
        body = {"url": f"{peer.url}/{number}.jpg", "role": "images"}
        return http.post(f"/v1/captures/{capture}/import", json=body)

    assert statuses(apps, ask) == {202: 3, 429: AT_ONCE - 3}


@pytest.mark.parametrize("limit", ["most_unfinished", "most_of_model"])
def test_orbit_videos(apps: list[ServedApp], limit: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(orbits.Orbits, limit, 3)
    path = f"/v1/models/{MODEL}/orbits"
    counts = statuses(apps, lambda http, number: http.post(path, json={"fps": 5 + number}))
    assert counts == {202: 3, 409: AT_ONCE - 3}
    assert len(apps[0].http.get(path).json()["orbits"]) == 3


def test_an_orbit_video_that_many_ask_for_is_one(apps: list[ServedApp]) -> None:
    path = f"/v1/models/{MODEL}/orbits"
    assert statuses(apps, lambda http, _: http.post(path, json={"fps": 5})) == {202: AT_ONCE}
    assert len(apps[0].http.get(path).json()["orbits"]) == 1


def test_webhooks(apps: list[ServedApp], peer: ScriptedServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(webhooks, "MAX_WEBHOOKS", 3)
    body = {"url": f"{peer.url}/hook"}
    assert statuses(apps, lambda http, _: http.post("/v1/webhooks", json=body)) == {
        201: 3,
        429: AT_ONCE - 3,
    }


def test_of_the_last_keys_of_admins_one_is_left(apps: list[ServedApp]) -> None:
    """Each revokes itself, so that all are let in."""
    admin: dict[str, Any] = {"name": "root", "owner": "root", "scopes": ["admin"]}
    made = [apps[0].http.post("/v1/keys", json=admin).json()]
    auth = {"Authorization": f"Bearer {made[0]['secret']}"}
    made += [apps[0].http.post("/v1/keys", json=admin, headers=auth).json() for _ in range(AT_ONCE - 1)]
    for app in apps:
        app.service.keys.read()

    def revoke(http: httpx.Client, number: int) -> httpx.Response:
        auth = {"Authorization": f"Bearer {made[number]['secret']}"}
        return http.delete(f"/v1/keys/{made[number]['id']}", headers=auth)

    assert statuses(apps, revoke) == {204: AT_ONCE - 1, 409: 1}
    for app in apps:
        app.service.keys.read()
    let_in = [
        apps[0].http.get("/v1/keys", headers={"Authorization": f"Bearer {key['secret']}"}).status_code
        for key in made
    ]
    assert Counter(let_in) == {401: AT_ONCE - 1, 200: 1}
