"""Browsers: sessions by cookie, and web pages of others that may not use the server, with and without keys.

Not proved here: what a browser itself does with a cookie that is HttpOnly and SameSite=Strict.
"""

from collections.abc import Mapping
from http.cookies import SimpleCookie
from pathlib import Path
from typing import Any

import httpx
import pytest
from starlette.datastructures import Headers

from splatmill.backplane import keys
from splatmill.sdk.client import Client
from splatmill_server.access.browsers import check_host, check_origin
from splatmill_server.access.sessions import COOKIE
from splatmill_server.base.problems import ProblemError
from tests.support.redis_server import empty_redis
from tests.support.served_app import Serve, ServedApp, problem, raw

pytestmark = pytest.mark.slow  # a server for each case


def here(app: ServedApp) -> str:
    """The address of the server, as a page of its own has it as origin."""
    return f"http://127.0.0.1:{app.address[1]}"


def begin(app: ServedApp, secret: str, **headers: str) -> tuple[httpx.Response, str]:
    """The answer to a browser that exchanges a key, and the cookie."""
    answer = app.http.post("/v1/session", headers={"Authorization": f"Bearer {secret}", **headers})
    app.http.cookies.clear()
    return answer, SimpleCookie(answer.headers.get("set-cookie", ""))[COOKIE].value


def with_cookie(cookie: str, **headers: str) -> dict[str, str]:
    return {"Authorization": "none", "Cookie": f"{COOKIE}={cookie}", **headers}


@pytest.fixture
def app(serve: Serve) -> ServedApp:
    return serve(api_key="s3cret")


@pytest.fixture
def ann(app: ServedApp) -> dict[str, Any]:
    return dict(app.http.post("/v1/keys", json={"name": "ann", "owner": "ann"}).json())


def test_a_session_stands_for_its_key_until_it_is_ended(app: ServedApp, ann: dict[str, Any]) -> None:
    answer, cookie = begin(app, ann["secret"])
    assert answer.status_code == 204
    sent = answer.headers["set-cookie"].lower()
    assert all(part in sent for part in ("httponly", "samesite=strict", "path=/", "max-age=43200"))
    assert "secure" not in sent
    caller = app.http.get("/v1/me", headers=with_cookie(cookie)).json()
    assert (caller["owner"], caller["key"], caller["scopes"]) == ("ann", ann["id"], ["read", "train"])
    made = app.http.post("/v1/captures", headers=with_cookie(cookie, Origin=here(app)))
    assert made.json()["owner"] == "ann"
    ended = app.http.delete("/v1/session", headers=with_cookie(cookie, Origin=here(app)))
    assert ended.status_code == 204
    assert "max-age=0" in ended.headers["set-cookie"].lower()
    problem(app.http.get("/v1/me", headers=with_cookie(cookie)), 401, "unauthorized")


def test_the_cookie_is_secure_behind_tls(app: ServedApp) -> None:
    origin = f"https://127.0.0.1:{app.address[1]}"
    assert "secure" in begin(app, "s3cret", Origin=origin)[0].headers["set-cookie"].lower()
    forwarded = {"X-Forwarded-Proto": "https", "X-Forwarded-For": "127.0.0.1"}
    assert "secure" in begin(app, "s3cret", **forwarded)[0].headers["set-cookie"].lower()


def test_a_session_is_stored_as_a_digest_and_expires(app: ServedApp, ann: dict[str, Any]) -> None:
    _, cookie = begin(app, ann["secret"])
    (name,) = app.redis.keys(keys.session("*"))
    assert 43_000 < app.redis.ttl(name) <= 43_200
    record = f"{name!r} {app.redis.get(name)!r}"
    assert ann["id"] in record
    assert cookie not in record
    assert ann["secret"] not in record
    app.redis.delete(name)
    problem(app.http.get("/v1/me", headers=with_cookie(cookie)), 401, "unauthorized")


def test_a_session_dies_with_its_key(serve: Serve, app: ServedApp, ann: dict[str, Any]) -> None:
    def status(cookie: str, at: ServedApp = app) -> int:
        return at.http.get("/v1/me", headers=with_cookie(cookie)).status_code

    _, first = begin(app, ann["secret"])
    rotated = app.http.post(f"/v1/keys/{ann['id']}/rotate").json()
    _, second = begin(app, rotated["secret"])
    assert (status(first), status(second)) == (401, 200)
    app.http.delete(f"/v1/keys/{ann['id']}")
    assert status(second) == 401
    _, admins = begin(app, "s3cret")
    assert status(admins) == 200
    assert status(admins, serve(api_key="another")) == 401


@pytest.mark.parametrize("headers", [{}, {"Origin": "null"}, {"Origin": "https://evil.example"}])
def test_a_write_with_a_cookie_comes_from_a_page_of_the_server(
    app: ServedApp, ann: dict[str, Any], headers: dict[str, str]
) -> None:
    _, cookie = begin(app, ann["secret"])
    for method, path in (("POST", "/v1/captures"), ("DELETE", "/v1/session"), ("POST", "/v1/jobs")):
        answer = app.http.request(method, path, headers=with_cookie(cookie, **headers))
        problem(answer, 403, "origin_not_allowed")
    other_port = with_cookie(cookie, Origin=f"http://127.0.0.1:{app.address[1] + 1}")
    problem(app.http.post("/v1/captures", headers=other_port), 403, "origin_not_allowed")
    assert app.http.get("/v1/me", headers=with_cookie(cookie, **headers)).status_code == 200
    site = with_cookie(cookie, **{"Sec-Fetch-Site": "same-origin"})
    assert app.http.post("/v1/captures", headers=site).status_code == 201
    # A page of another address may not make a session of its own key either.
    evil = {"Authorization": f"Bearer {ann['secret']}", "Origin": "https://evil.example"}
    problem(app.http.post("/v1/session", headers=evil), 403, "origin_not_allowed")


def test_a_session_is_made_from_a_key_alone(serve: Serve, app: ServedApp, ann: dict[str, Any]) -> None:
    _, cookie = begin(app, ann["secret"])
    again = app.http.post("/v1/session", headers=with_cookie(cookie, Origin=here(app)))
    problem(again, 401, "session_needs_key")
    problem(app.http.post("/v1/session", headers={"Authorization": "none"}), 401, "unauthorized")
    for wrong in ("", "x", cookie[:-1], cookie.upper()):
        problem(app.http.get("/v1/me", headers=with_cookie(wrong)), 401, "unauthorized")


def test_a_server_without_keys_has_no_sessions(serve: Serve) -> None:
    answer = serve().http.post("/v1/session", headers={"Authorization": "Bearer any"})
    problem(answer, 401, "session_needs_key")


def test_without_redis_sessions_wait_and_keys_work(serve: Serve, tmp_path: Path) -> None:
    with empty_redis(tmp_path / "r") as url:
        app = serve(redis_url=url, api_key="s3cret")
        _, cookie = begin(app, "s3cret")
    answer = app.http.get("/v1/models", headers=with_cookie(cookie))
    problem(answer, 503, "queue_unavailable")
    assert answer.headers["retry-after"]
    problem(app.http.get(f"/v1/captures/{'0' * 16}"), 404, "capture_not_found")


OWN = ["localhost", "localhost:8080", "LOCALHOST.", "127.0.0.1", "127.1.2.3:9", "[::1]:80", "app.localhost"]
FOREIGN = [
    "evil.example",
    "evil.example:8080",
    "localhost.evil.example",
    "127.0.0.1.evil.example",
    "10.0.0.1",
]
FOREIGN += ["", "[::1", "evil.example@localhost.evil.example", "evil.example@localhost", "localhost:x.evil"]
FOREIGN += ["localhost/x"]


@pytest.mark.parametrize("host", OWN)
def test_a_server_without_keys_answers_to_names_of_its_machine(serve: Serve, host: str) -> None:
    app = serve()
    assert app.http.get("/v1/jobs", headers={"Host": host}).status_code == 200
    assert app.http.post("/v1/captures", headers={"Host": host}).status_code == 201


def test_a_server_without_keys_answers_to_no_other_name(serve: Serve) -> None:
    app = serve()
    for host in FOREIGN:
        status, body = raw(app, "GET /v1/jobs HTTP/1.1", b"", host=host)
        assert (status, b"host_not_allowed" in body) == (421, True), host
        assert b"SPLATMILL_ALLOWED_HOSTS" in body
    # The absolute form of a request's address names no host that counts.
    status, _ = raw(app, "GET http://localhost/v1/jobs HTTP/1.1", b"", host="evil.example")
    assert status != 200
    # Probes may use any name.
    assert raw(app, "GET /healthz HTTP/1.1", b"", host="10.0.0.1")[0] == 200


def test_names_of_a_proxy_can_be_allowed(serve: Serve) -> None:
    app = serve(allowed_hosts="splat.example.org, *.lab.example")
    for host in ("splat.example.org", "a.lab.example:80", "localhost"):
        assert raw(app, "GET /v1/jobs HTTP/1.1", b"", host=host)[0] == 200
    for host in ("lab.example", "xlab.example", "example.org"):
        assert raw(app, "GET /v1/jobs HTTP/1.1", b"", host=host)[0] == 421
    # A proxy may change Host to its own address; Origin stays that of the page.
    page = {"Origin": "https://splat.example.org"}
    assert app.http.post("/v1/captures", headers=page).status_code == 201


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "https://evil.example"},
        {"Origin": "null"},
        {"Origin": ""},
        {"Origin": "http://localhost:1"},
        {"Origin": "file://"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site"},
    ],
)
def test_a_page_of_others_cannot_start_a_training(serve: Serve, headers: dict[str, str]) -> None:
    app = serve()
    capture = app.capture()
    refused = [
        app.http.post("/v1/jobs", json={"capture": capture}, headers=headers),
        app.http.post("/v1/jobs", files=[("images", ("a.jpg", b"a"))], headers=headers),
        app.http.post("/v1/captures", headers=headers),
        app.http.delete(f"/v1/captures/{capture}", headers=headers),
        app.http.post("/v1/keys", json={"name": "x", "scopes": ["admin"]}, headers=headers),
    ]
    for answer in refused:
        problem(answer, 403, "origin_not_allowed")
    assert app.http.get("/v1/jobs").json()["jobs"] == []


def test_programs_and_own_pages_use_a_server_without_keys(serve: Serve) -> None:
    app = serve()
    for headers in (
        {},
        {"Origin": here(app)},
        {"Origin": here(app), "Sec-Fetch-Site": "same-origin"},
        {"Sec-Fetch-Site": "none"},
    ):
        assert app.http.post("/v1/captures", headers=headers).status_code == 201
    named = {"Host": f"localhost:{app.address[1]}", "Origin": f"http://localhost:{app.address[1]}"}
    assert app.http.post("/v1/captures", headers=named).status_code == 201
    with Client(here(app)) as client:
        assert client.me().owner == "default"


SOCKET: Mapping[str, Any] = {"type": "http", "method": "POST", "server": ("/run/splatmill.sock", None)}


def test_a_unix_socket_is_checked_too() -> None:
    check_host(dict(SOCKET), Headers({"host": "localhost"}), "127.0.0.1", [])
    check_host(dict(SOCKET), Headers({"host": "splat.example.org"}), "127.0.0.1", ["splat.example.org"])
    with pytest.raises(ProblemError):
        check_host(dict(SOCKET), Headers({"host": "evil.example"}), "127.0.0.1", [])
    with pytest.raises(ProblemError):
        check_origin(dict(SOCKET), Headers({"host": "localhost", "origin": "null"}), [], required=False)


def test_a_server_with_keys_answers_to_any_name(app: ServedApp) -> None:
    assert app.http.get("/v1/jobs", headers={"Host": "splat.example.org"}).status_code == 200
    answer = app.http.post("/v1/captures", headers={"Origin": "https://elsewhere.example"})
    assert answer.status_code == 201  # a page that knows the key


@pytest.mark.parametrize(
    "origin", ["http://[", "http://[::1", "http://a]", f"http://a:{'9' * 5000}", "null", "//"]
)
def test_an_origin_that_cannot_be_read_is_refused_with_a_session_too(
    app: ServedApp, ann: dict[str, Any], origin: str
) -> None:
    _, cookie = begin(app, ann["secret"])
    answer = app.http.post("/v1/captures", json={}, headers=with_cookie(cookie, Origin=origin))
    problem(answer, 403, "origin_not_allowed")
