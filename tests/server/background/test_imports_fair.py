"""No owner's imports hold up another's: slow servers, servers that fail, and captures that are deleted, over real HTTP.

Not proved here: what a whole import stores (test_imports).
"""

import asyncio
import time
from collections.abc import Iterator
from typing import Any

import pytest

from splatmill.backplane import keys
from splatmill.backplane.storage import layout
from splatmill_server.background import imports
from splatmill_server.base import least_rate, unfinished
from splatmill_server.space import usage
from tests.support.served_app import Serve, ServedApp, problem, stored
from tests.support.servers.scripted_server import Reply, Request, ScriptedServer, scripted_server
from tests.support.waiting import wait_for

CRAWLING = Reply(body=b"x" * 5000, pace=0.05)
"""20 bytes a second, for four minutes."""


def answer(request: Request) -> Reply:
    return {"/slow": CRAWLING, "/busy": Reply(status=503)}.get(
        request.path.split("?")[0], Reply(body=b"photo")
    )


@pytest.fixture
def peer() -> Iterator[ScriptedServer]:
    with scripted_server() as server:
        server.answer = answer
        yield server


@pytest.fixture
def app(serve: Serve, peer: ScriptedServer, monkeypatch: pytest.MonkeyPatch) -> ServedApp:
    monkeypatch.setattr(imports, "_LOOK_SECONDS", 0.2)
    return serve(outgoing_allow=peer.url.removeprefix("http://"))


def capture(app: ServedApp, owner: str = "ann") -> str:
    return app.service.captures.create(owner=owner)[0].id


def begin(app: ServedApp, capture_id: str, url: str, name: str = "a.jpg") -> str:
    answer = app.http.post(f"/v1/captures/{capture_id}/import", json={"url": url, "name": name})
    assert answer.status_code == 202, answer.text
    return str(answer.headers["location"])


def state(app: ServedApp, address: str) -> Any:
    return app.http.get(address).json()["state"]


def test_slow_imports_of_one_owner_do_not_hold_up_another_owner(app: ServedApp, peer: ScriptedServer) -> None:
    captures = [capture(app) for _ in range(5)]
    for number in range(20):
        begin(app, captures[number % 5], f"{peer.url}/slow", f"{number}.jpg")
    wait_for(lambda: len(peer.requests) >= 3)
    other = begin(app, capture(app, "bob"), f"{peer.url}/fast")
    wait_for(lambda: state(app, other) == "succeeded", 10)
    assert len([request for request in peer.requests if request.path == "/slow"]) == imports._CONCURRENT_EACH


def test_a_pause_before_another_attempt_holds_no_slot(
    app: ServedApp, peer: ScriptedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(imports, "_PAUSE_SECONDS", 25.0)
    capture_id = capture(app)
    busy = [begin(app, capture_id, f"{peer.url}/busy", f"{n}.jpg") for n in range(12)]
    good = begin(app, capture_id, f"{peer.url}/fast")
    wait_for(lambda: state(app, good) == "succeeded", 20)
    wait_for(lambda: [state(app, address) for address in busy] == ["queued"] * 12)
    assert [app.http.get(address).json()["attempts"] for address in busy] == [1] * 12


def test_no_other_process_cuts_a_pause_short(
    serve: Serve, peer: ScriptedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(imports, "_LOOK_SECONDS", 0.05)
    monkeypatch.setattr(imports, "_PAUSE_SECONDS", 1.5)
    apps = [serve(outgoing_allow=peer.url.removeprefix("http://")) for _ in range(2)]
    begun = time.monotonic()
    address = begin(apps[0], capture(apps[0]), f"{peer.url}/busy")
    wait_for(lambda: len(peer.requests) == 2)
    assert time.monotonic() - begun > 1.5
    assert apps[1].http.get(address).json()["attempts"] == 2


def test_a_server_that_sends_too_slowly_fails_the_import(
    serve: Serve, peer: ScriptedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(least_rate, "SECONDS", 0.6)
    allowed = peer.url.removeprefix("http://")
    app = serve(outgoing_allow=allowed, min_import_rate=200)
    address = begin(app, capture(app), f"{peer.url}/slow")
    wait_for(lambda: state(app, address) == "failed", 10)
    record = app.http.get(address).json()
    assert record["problem"]["code"] == "import_failed"
    assert "200 B per second" in record["problem"]["detail"], record
    assert "SPLATMILL_MIN_IMPORT_RATE" in record["problem"]["detail"]
    assert record["attempts"] == 1
    assert not any("incoming" in path or "files" in path for path in stored(app))
    # One that is fast enough may take any number of windows, and 0 admits any rate.
    peer.answer = lambda _: Reply(body=b"x" * 40, pace=0.05)
    for rate in (5, 0):
        app = serve(outgoing_allow=allowed, min_import_rate=rate)
        address = begin(app, capture(app), f"{peer.url}/steady")
        wait_for(lambda: state(app, address) == "succeeded", 10)  # noqa: B023  # called at once


def test_a_server_that_never_answers_fails_the_import(
    app: ServedApp, peer: ScriptedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(imports, "_ANSWER_SECONDS", 0.2)
    monkeypatch.setattr(imports, "_PAUSE_SECONDS", 0.01)

    async def never(_: Request) -> Reply:
        await asyncio.sleep(60)
        return Reply()

    peer.answer = never
    address = begin(app, capture(app), f"{peer.url}/a.jpg")
    wait_for(lambda: state(app, address) == "failed", 20)
    record = app.http.get(address).json()
    assert (record["attempts"], record["problem"]["code"]) == (imports.MAX_ATTEMPTS, "import_failed")
    assert "did not begin to answer" in record["problem"]["detail"]


@pytest.mark.parametrize("elsewhere", [False, True])
def test_the_deletion_of_a_capture_ends_its_imports_at_once(
    app: ServedApp, serve: Serve, peer: ScriptedServer, monkeypatch: pytest.MonkeyPatch, elsewhere: bool
) -> None:
    monkeypatch.setattr(unfinished, "DELETED_SECONDS", 0.1 if elsewhere else 60.0)
    capture_id = capture(app)
    begin(app, capture_id, f"{peer.url}/slow")
    wait_for(lambda: len(peer.requests) == 1)
    other = (
        serve() if elsewhere else app
    )  # a process that does not run the import, which the first one has begun
    assert other.http.delete(f"/v1/captures/{capture_id}").status_code == 204
    wait_for(lambda: peer.left == 1, 5)
    wait_for(lambda: stored(app) == [], 5)
    assert app.service.imports.unfinished.running == {}
    assert list(app.service.storage.entries(layout.unfinished_imports())) == []


def test_an_owner_has_a_bounded_number_of_unfinished_imports(
    app: ServedApp, peer: ScriptedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(imports, "MAX_OF_OWNER", 3)
    for _ in range(3):
        begin(app, capture(app), f"{peer.url}/slow")
    body = {"url": f"{peer.url}/slow", "name": "a.jpg"}
    refused = problem(
        app.http.post(f"/v1/captures/{capture(app)}/import", json=body), 429, "too_many_requests"
    )
    assert refused["detail"] == "The owner has 3 imports that have not ended."
    begin(app, capture(app, "bob"), f"{peer.url}/fast")


def test_an_import_waits_while_storage_is_listed_for_the_first_time(
    serve: Serve, peer: ScriptedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(imports, "_LOOK_SECONDS", 0.05)
    monkeypatch.setattr(imports, "_PAUSE_SECONDS", 0.05)
    monkeypatch.setattr(usage, "_FIRST_SCAN_SECONDS", 0.1)
    app = serve(outgoing_allow=peer.url.removeprefix("http://"), quota=10**9)

    def lose_figures(request: Request) -> Reply:
        """Let Redis lose the last scan while another process makes a new one, until the third attempt."""
        connection = app.service.redis
        if len(peer.requests) == 1:
            connection.set(keys.SCAN_LOCK, "another process", ex=30)
            connection.delete(keys.SCAN)
            return Reply(status=503)
        if len(peer.requests) == 3:
            connection.delete(keys.SCAN_LOCK)
        return Reply(body=b"photo")

    peer.answer = lose_figures
    address = begin(app, capture(app), f"{peer.url}/a.jpg")
    wait_for(lambda: state(app, address) in ("succeeded", "failed"))
    record = app.http.get(address).json()
    assert (record["state"], record["attempts"]) == ("succeeded", 3), record
