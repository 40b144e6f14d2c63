"""Links to models over HTTP: what they open and for whom, how they end, and what the log and storage keep of the token.

Not proved here: the pages of a link in a browser (tests/browser), renders of a real renderer (tests/server/responses).
"""

from __future__ import annotations

import json
import re
from datetime import UTC, datetime, timedelta
from typing import Any

import httpx
import pytest
from structlog.testing import CapturingLogger

from splatmill.backplane.storage import layout
from splatmill_server.routes import shared
from splatmill_server.shares import KEPT_ENDED, MAX_SHARES
from tests.support.served_app import Serve, ServedApp, problem, store_model, stored
from tests.support.waiting import wait_for

MODEL, OTHER = "0123456789abcdef", "fedcba9876543210"


@pytest.fixture
def app(serve: Serve) -> ServedApp:
    """A server with a key, and two models."""
    app = serve(api_key="s3cret")
    for model_id in (MODEL, OTHER):
        store_model(app.service, model_id, "still life <&>")
    return app


@pytest.fixture
def stranger(app: ServedApp) -> Any:
    """Somebody without a key."""
    with httpx.Client(base_url=app.http.base_url, timeout=60) as http:
        yield http


def share(app: ServedApp, model_id: str = MODEL, **body: Any) -> dict[str, Any]:
    answer = app.http.post(f"/v1/models/{model_id}/shares", json=body)
    assert answer.status_code == 201, answer.text
    assert answer.headers["cache-control"] == "no-store"
    return dict(answer.json())


def age(app: ServedApp, made: dict[str, Any], by: timedelta) -> None:
    """Move a link into the past."""
    path = layout.share_record(made["model"], made["id"])
    record = json.loads(app.service.storage.get(path))
    for name in ("created_at", "expires_at"):
        record[name] = (datetime.fromisoformat(record[name]) - by).isoformat()
    app.service.storage.put(path, json.dumps(record).encode())


def test_a_link_opens_its_model_and_nothing_else(app: ServedApp, stranger: httpx.Client) -> None:
    app.service.storage.put(layout.model_file(MODEL, "frame.json"), b"{}")
    made = share(app, name="for mum", expires_in="12h")
    assert made["path"] == f"/s/{made['token']}"
    left = datetime.fromisoformat(made["expires_at"]) - datetime.now(UTC)
    assert timedelta(hours=11) < left <= timedelta(hours=12)

    base = f"{made['path']}/model"
    model = stranger.get(base).json()
    assert (model["id"], model["name"], model["gaussians"]) == (MODEL, "still life <&>", 2)
    assert not {"owner", "job", "links"} & set(model)
    assert not {"job.json", "frame.json", "report.json"} & {file["name"] for file in model["files"]}
    own = app.http.get(f"/v1/models/{MODEL}/files/model.ply")
    assert stranger.get(f"{base}/files/model.ply").content == own.content
    part = stranger.get(f"{base}/files/model.ply", headers={"Range": "bytes=0-2"})
    assert (part.status_code, part.content) == (206, b"ply")
    assert stranger.head(f"{base}/files/model.ply").headers["etag"] == own.headers["etag"]
    assert stranger.get(f"{base}/cameras").json() == {"cameras": [], "up": None}
    for hidden in ("job.json", "frame.json", "report.json"):
        problem(stranger.get(f"{base}/files/{hidden}"), 404, "file_not_found")
    problem(stranger.get(f"{base}/files/..%2f..%2f{OTHER}%2fmodel.ply"), 404, "file_not_found")

    formats = {form["format"]: form for form in stranger.get(f"{base}/formats").json()["formats"]}
    assert "sog" in formats
    assert formats["ply"]["address"] == f"{base}/download/ply"
    assert stranger.get(formats["ply"]["address"]).content == own.content
    problem(stranger.get(f"{base}/download/none"), 404, "format_unknown")

    # The token is no key, and the link is read-only.
    for path in (f"/v1/models/{MODEL}", "/v1/models", f"/v1/models/{MODEL}/shares", "/v1/me"):
        answer = stranger.get(path, headers={"Authorization": f"Bearer {made['token']}"})
        problem(answer, 401, "unauthorized")
        assert stranger.get(path, params={"token": made["token"]}).status_code == 401
    for method in ("POST", "PUT", "PATCH", "DELETE"):
        for path in (base, f"{base}/files/model.ply", f"{base}/render", made["path"]):
            assert stranger.request(method, path).status_code == 405, (method, path)
    # Another model's id with this link's secret opens nothing.
    problem(stranger.get(f"/s/{made['token'].replace(MODEL, OTHER)}/model"), 404, "share_not_found")


@pytest.mark.parametrize(
    "token",
    [
        "x",
        f"{MODEL}-00000000-{'0' * 32}",
        f"{MODEL}-00000000",
        "..%2f..%2fkeys",
        "%00",
        f"{MODEL}-0000000g-{'0' * 32}",
    ],
)
def test_a_guess_opens_nothing(app: ServedApp, stranger: httpx.Client, token: str) -> None:
    share(app)
    answer = stranger.get(f"/s/{token}/model")
    assert answer.status_code == 404
    assert answer.json()["code"] in ("share_not_found", "not_found")
    assert stranger.get(f"/s/{token}").status_code == 404


def test_a_wrong_secret_is_not_told_from_an_unknown_link(app: ServedApp, stranger: httpx.Client) -> None:
    token = share(app)["token"]
    wrong = token[:-1] + ("0" if token[-1] != "0" else "1")
    unknown = f"{MODEL}-{'0' * 8}-{token[-32:]}"
    refusals = [problem(stranger.get(f"/s/{t}/model"), 404, "share_not_found") for t in (wrong, unknown)]
    assert refusals[0]["detail"] == refusals[1]["detail"]


def test_links_end_by_revocation_expiry_and_with_the_model(app: ServedApp, stranger: httpx.Client) -> None:
    revoked, expired, last = share(app), share(app), share(app)
    assert app.http.delete(f"/v1/models/{MODEL}/shares/{revoked['id']}").status_code == 204
    age(app, expired, timedelta(days=31))
    for ended, verb in ((revoked, "was revoked"), (expired, "expired")):
        for path in ("/model", "/model/files/model.ply", "/model/cameras", "/model/render"):
            assert verb in problem(stranger.get(ended["path"] + path), 410, "share_ended")["detail"]
        assert stranger.get(ended["path"]).status_code == 410
        assert "og:title" not in stranger.get(ended["path"]).text
    assert stranger.get(last["path"] + "/model").status_code == 200
    listed = app.http.get(f"/v1/models/{MODEL}/shares").json()["shares"]
    assert {entry["id"]: entry["active"] for entry in listed} == {
        revoked["id"]: False,
        expired["id"]: False,
        last["id"]: True,
    }
    # Revoking again changes nothing, and does not renew it.
    assert app.http.delete(f"/v1/models/{MODEL}/shares/{revoked['id']}").status_code == 204
    problem(app.http.delete(f"/v1/models/{MODEL}/shares/00000000"), 404, "share_not_found")
    problem(app.http.delete(f"/v1/models/{OTHER}/shares/{last['id']}"), 404, "share_not_found")

    running = app.job()
    app.begin(running)
    kept = layout.share_record(running, "fedcba98")
    app.service.storage.put(kept, b"{}")
    problem(app.http.delete(f"/v1/jobs/{running}"), 409, "job_running")
    assert app.service.storage.exists(kept), "a refused deletion deletes nothing"
    app.service.storage.delete(kept)

    assert app.http.delete(f"/v1/jobs/{MODEL}").status_code == 204
    problem(stranger.get(last["path"] + "/model"), 404, "share_not_found")
    assert not [path for path in stored(app) if path.startswith("shares/")]


def test_only_the_digest_of_a_token_is_kept(
    app: ServedApp, stranger: httpx.Client, lines: CapturingLogger
) -> None:
    made = share(app)
    secret = made["token"].rsplit("-", 1)[-1]
    paths = ("", "/embed", "/model", "/model/files/model.ply", "/model/files/nothing", "/nothing")
    for path in paths:
        stranger.get(made["path"] + path)

    def visits() -> list[dict[str, Any]]:
        logged = [dict(call.kwargs) for call in lines.calls]
        return [line for line in logged if line["event"] == "request" and line["method"] == "GET"]

    # The line of a request is written after its answer.
    requests = wait_for(lambda: entries if len(entries := visits()) == len(paths) else None)
    logged = [dict(call.kwargs) for call in lines.calls]
    assert secret not in json.dumps(logged, default=str)
    assert {line["path"] for line in requests} >= {"/s/...", "/s/.../embed", "/s/.../model/files/model.ply"}
    assert f"link {made['id']}" in {line["key"] for line in requests}
    root = app.service.storage.root
    assert root is not None
    assert not [path for path in root.rglob("*") if path.is_file() and secret.encode() in path.read_bytes()]
    assert secret not in app.http.get(f"/v1/models/{MODEL}/shares").text
    assert secret not in app.http.get("/metrics").text


def test_a_link_may_ask_so_often_a_minute(app: ServedApp, stranger: httpx.Client, monkeypatch: Any) -> None:
    monkeypatch.setattr(shared, "LIMITS", shared.LIMITS.model_copy(update={"requests_per_minute": 3}))
    one, other = share(app), share(app)
    assert [stranger.get(one["path"] + "/model").status_code for _ in range(4)] == [200, 200, 200, 429]
    assert stranger.get(other["path"] + "/model").status_code == 200


def test_links_to_a_model_are_bounded_and_old_ones_forgotten(app: ServedApp) -> None:
    first = share(app)
    for _ in range(MAX_SHARES - 1):
        share(app)
    problem(app.http.post(f"/v1/models/{MODEL}/shares", json={}), 429, "too_many_requests")
    age(app, first, KEPT_ENDED + timedelta(days=31))
    share(app)
    listed = {entry["id"] for entry in app.http.get(f"/v1/models/{MODEL}/shares").json()["shares"]}
    assert first["id"] not in listed
    assert len(listed) == MAX_SHARES


@pytest.mark.parametrize(
    "body", [{"expires_in": 0}, {"expires_in": "forever"}, {"expires_in": "3651d"}, {"model": "x"}]
)
def test_bad_requests_are_refused(app: ServedApp, body: dict[str, Any]) -> None:
    problem(app.http.post(f"/v1/models/{MODEL}/shares", json=body), 422, "invalid_request")
    assert app.http.get(f"/v1/models/{MODEL}/shares").json() == {"shares": []}


def test_a_record_that_cannot_be_read_opens_nothing(app: ServedApp, stranger: httpx.Client) -> None:
    made = share(app)
    app.service.storage.put(layout.share_record(MODEL, made["id"]), b'{"id": "x"}')
    problem(stranger.get(made["path"] + "/model"), 404, "share_not_found")
    assert app.http.get(f"/v1/models/{MODEL}/shares").json() == {"shares": []}


def test_only_the_frame_may_be_framed_and_the_page_has_a_poster(
    app: ServedApp, stranger: httpx.Client
) -> None:
    made = share(app)
    page, frame = stranger.get(made["path"]), stranger.get(made["path"] + "/embed")
    assert "frame-ancestors 'none'" in page.headers["content-security-policy"]
    assert page.headers["x-frame-options"] == "DENY"
    assert "frame-ancestors *" in frame.headers["content-security-policy"]
    assert "x-frame-options" not in frame.headers
    for answer in (page, frame):
        assert answer.headers["referrer-policy"] == "no-referrer"
        assert answer.headers["x-robots-tag"] == "noindex"
    meta = dict(re.findall(r'<meta property="([^"]+)" content="([^"]*)">', page.text))
    assert meta["og:title"] == "still life &lt;&amp;&gt;"
    assert "2 Gaussians, 27.5 dB" in meta["og:description"]
    picture = stranger.get(meta["og:image"])
    assert picture.headers["content-type"] == "image/jpeg"
    assert meta["og:image"].startswith(str(app.http.base_url))
