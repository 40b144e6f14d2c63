"""Imports over real HTTP from a real other server: what arrives is stored as an upload is, and what fails has a reason.

Not proved here: which addresses are refused (test_outgoing).
"""

import asyncio
import hashlib
import os
from collections.abc import Iterator
from typing import Any

import pytest

from splatmill.backplane import keys
from splatmill.backplane.storage import layout
from splatmill.schema import Role
from splatmill_server.background import imports
from tests.support.served_app import Serve, ServedApp, problem, stored
from tests.support.servers.scripted_server import Reply, ScriptedServer, scripted_server
from tests.support.waiting import wait_for

DATA = os.urandom(400_000)


@pytest.fixture
def peer() -> Iterator[ScriptedServer]:
    with scripted_server() as server:
        server.answer = lambda _: Reply(body=DATA)
        yield server


@pytest.fixture(autouse=True)
def _short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(imports, "_PAUSE_SECONDS", 0.01)
    monkeypatch.setattr(imports, "_LOOK_SECONDS", 0.2)


@pytest.fixture
def app(serve: Serve, peer: ScriptedServer) -> ServedApp:
    return serve(outgoing_allow=peer.url.removeprefix("http://"))


def capture(app: ServedApp) -> str:
    return str(app.http.post("/v1/captures", json={}).json()["id"])


def begin(app: ServedApp, capture_id: str, url: str, **more: Any) -> str:
    answer = app.http.post(f"/v1/captures/{capture_id}/import", json={"url": url} | more)
    assert answer.status_code == 202, answer.text
    assert answer.json()["state"] == "queued"
    return str(answer.headers["location"])


def ended(app: ServedApp, address: str) -> Any:
    wait_for(lambda: app.http.get(address).json()["state"] in ("succeeded", "failed"))
    wait_for(lambda: list(app.service.storage.entries(layout.unfinished_imports())) == [])
    return app.http.get(address).json()


def test_a_file_is_fetched_and_stored_as_an_upload_is(app: ServedApp, peer: ScriptedServer) -> None:
    capture_id = capture(app)
    sha256 = hashlib.sha256(DATA).hexdigest()
    address = begin(app, capture_id, f"{peer.url}/sets/my%20kitchen.zip?token=1", sha256=sha256)
    done = ended(app, address)
    assert done["state"] == "succeeded"
    assert done["file"] == {"role": "images", "name": "my kitchen.zip", "size": len(DATA), "sha256": sha256}
    assert (done["received"], done["size"], done["attempts"]) == (len(DATA), len(DATA), 1)
    assert app.http.get(f"/v1/captures/{capture_id}").json()["files"] == [done["file"]]
    assert app.service.storage.get(layout.capture_file(capture_id, Role.images, "my kitchen.zip")) == DATA
    assert peer.requests[0].path == "/sets/my%20kitchen.zip?token=1"
    # A second import of the same bytes under another role and name, and the list of both.
    other = ended(app, begin(app, capture_id, f"{peer.url}/x", role="poses", name="sparse/0/images.bin"))
    assert other["file"]["name"] == "sparse/0/images.bin"
    listed = app.http.get(f"/v1/captures/{capture_id}/imports").json()["imports"]
    assert [entry["id"] for entry in listed] == [other["id"], done["id"]]
    assert app.redis.keys(keys.lease("*", "*")) == []


def test_what_cannot_be_stored_is_a_failed_import_with_its_reason(serve: Serve, peer: ScriptedServer) -> None:
    app = serve(max_file_bytes=1000, outgoing_allow=peer.url.removeprefix("http://"))
    capture_id = capture(app)

    def failed(reply: Reply, code: str, **more: Any) -> Any:
        peer.answer = lambda _: reply
        record = ended(app, begin(app, capture_id, f"{peer.url}/a.jpg", **more))
        assert record["state"] == "failed"
        assert record["problem"]["code"] == code, record
        return record

    failed(Reply(body=b"x" * 1001), "body_too_large")
    # The limit also holds where no length is announced.
    failed(Reply(body=b"x" * 1001, headers={"Content-Length": ""}), "import_failed")
    failed(Reply(body=b""), "file_empty")
    failed(Reply(body=b"x"), "digest_mismatch", sha256="0" * 64)
    assert failed(Reply(status=404), "import_failed")["attempts"] == 1
    failed(Reply(body=b"x", headers={"Content-Encoding": "gzip"}), "import_failed")
    failed(Reply(status=302, headers={"Location": "http://169.254.169.254/latest/"}), "url_refused")
    assert app.http.get(f"/v1/captures/{capture_id}").json()["files"] == []
    assert not any("incoming" in path for path in stored(app))
    app.http.put(f"/v1/captures/{capture_id}/images/a.jpg", content=b"there")
    failed(Reply(body=b"other"), "name_taken")


def test_an_address_is_refused_at_once(app: ServedApp, peer: ScriptedServer) -> None:
    capture_id = capture(app)
    address = f"/v1/captures/{capture_id}/import"
    before = stored(app)
    for url in (
        "http://127.0.0.1/a.jpg",
        "file:///etc/passwd",
        "http://u:p@8.8.8.8/a.jpg",
        "http://[::1]:8080/a",
    ):
        problem(app.http.post(address, json={"url": url}), 422, "url_refused")
    problem(app.http.post(address, json={"url": f"{peer.url}/"}), 422, "name_invalid")
    problem(app.http.post(address, json={"url": f"{peer.url}/%2e%2e%2fa"}), 422, "name_invalid")
    problem(app.http.post(address, json={"url": f"{peer.url}/a", "name": "../a"}), 422, "invalid_request")
    problem(
        app.http.post("/v1/captures/0123456789abcdef/import", json={"url": peer.url}),
        404,
        "capture_not_found",
    )
    problem(app.http.get(f"/v1/captures/{capture_id}/imports/0123456789abcdef"), 404, "import_not_found")
    assert stored(app) == before
    assert peer.requests == []


def test_a_server_that_fails_for_a_while_is_asked_again(app: ServedApp, peer: ScriptedServer) -> None:
    replies = iter([Reply(status=503), Reply(dropped=True), Reply(body=DATA, cut=100_000), Reply(body=DATA)])
    peer.answer = lambda _: next(replies)
    done = ended(app, begin(app, capture(app), f"{peer.url}/a.mp4"))
    assert (done["state"], done["attempts"]) == ("succeeded", 4)
    peer.answer = lambda _: Reply(status=500)
    failed = ended(app, begin(app, capture(app), f"{peer.url}/a.mp4"))
    assert (failed["state"], failed["attempts"]) == ("failed", imports.MAX_ATTEMPTS)
    assert "500" in failed["problem"]["detail"]


def test_an_import_goes_on_after_a_restart_of_the_server(
    serve: Serve, peer: ScriptedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def never(_: Any) -> Reply:
        await asyncio.sleep(60)
        return Reply()

    peer.answer = never
    allow = peer.url.removeprefix("http://")
    first = serve(outgoing_allow=allow)
    capture_id = capture(first)
    address = begin(first, capture_id, f"{peer.url}/a.mp4")
    wait_for(lambda: len(peer.requests) == 1)
    # A second process leaves it alone while the first one has it.
    second = serve(outgoing_allow=allow)
    key = keys.lease("import", f"{capture_id}.{address.rsplit('/', 1)[1]}")
    wait_for(lambda: first.redis.exists(key) == 1)
    peer.answer = lambda _: Reply(body=DATA)
    assert second.http.get(address).json()["state"] == "running"
    assert len(peer.requests) == 1
    # What a killed process leaves: a record, a mark, and a lease that expires.
    first.service.imports.unfinished.running[f"{capture_id}.{address.rsplit('/', 1)[1]}"].cancel()
    done = ended(second, address)
    assert (done["state"], done["attempts"]) == ("succeeded", 2)


def test_the_import_into_a_deleted_capture_leaves_nothing(app: ServedApp, peer: ScriptedServer) -> None:
    capture_id = capture(app)

    async def late(_: Any) -> Reply:
        await asyncio.to_thread(app.http.delete, f"/v1/captures/{capture_id}")
        return Reply(body=DATA)

    peer.answer = late
    begin(app, capture_id, f"{peer.url}/a.mp4")
    wait_for(lambda: stored(app) == [])


def test_a_redirect_to_an_address_that_cannot_be_read_ends_the_import(
    app: ServedApp, peer: ScriptedServer
) -> None:
    peer.answer = lambda _: Reply(status=302, headers={"Location": "http://xn--/"})
    done = ended(app, begin(app, capture(app), f"{peer.url}/a.jpg"))
    assert (done["state"], done["problem"]["code"], done["attempts"]) == ("failed", "url_refused", 1)
    assert "'http://xn--/' is not an address" in done["problem"]["detail"]
    assert len(peer.requests) == 1


def test_an_error_that_nobody_expected_counts_as_an_attempt(
    app: ServedApp, peer: ScriptedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_: object) -> None:
        raise RecursionError

    monkeypatch.setattr(imports, "_check", broken)
    done = ended(app, begin(app, capture(app), f"{peer.url}/a.jpg"))
    assert (done["state"], done["attempts"]) == ("failed", imports.MAX_ATTEMPTS)
    assert "unexpected error (RecursionError)" in done["problem"]["detail"]
    assert len(peer.requests) == imports.MAX_ATTEMPTS
