"""Web pages of other origins (CORS): which may use the API, what their browsers are told, and that sessions are
not theirs.

Not proved here: that a browser keeps to it.
"""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from splatmill_server.access.cors import EXPOSED
from splatmill_server.access.sessions import COOKIE
from splatmill_server.base.settings import Settings
from tests.support.served_app import Serve, ServedApp, problem

APP = "https://app.example.org"

SENT = "authorization,content-type,idempotency-key,if-none-match,last-event-id,range,upload-complete,upload-length,"
SENT += "upload-offset,x-content-sha256,x-request-id"
"""Headers that the SDK and the web page send, as a browser lists them."""


def preflight(app: ServedApp, method: str, origin: str = APP, path: str = "/v1/jobs") -> dict[str, str]:
    """The headers of the answer to a browser that asks before it sends a request."""
    answer = app.http.options(
        path,
        headers={
            "Authorization": "",
            "Origin": origin,
            "Access-Control-Request-Method": method,
            "Access-Control-Request-Headers": SENT,
        },
    )
    return dict(answer.headers)


@pytest.fixture
def app(serve: Serve) -> ServedApp:
    return serve(api_key="s3cret", cors_origins=f"{APP}, http://localhost:5173")


@pytest.mark.parametrize("method", ["GET", "HEAD", "POST", "PUT", "PATCH", "DELETE"])
def test_a_page_may_send_every_request_that_the_api_has(app: ServedApp, method: str) -> None:
    for origin in (APP, "http://localhost:5173"):
        told = preflight(app, method, origin)
        assert told["access-control-allow-origin"] == origin
        assert method in told["access-control-allow-methods"]
        assert told["access-control-allow-headers"] == SENT
        assert "access-control-allow-credentials" not in told
    assert "origin" in told["vary"].lower()


@pytest.mark.parametrize(
    "origin",
    ["https://evil.example", "https://app.example.org.evil.example", "http://app.example.org", "null"],
)
def test_other_pages_are_told_nothing(app: ServedApp, origin: str) -> None:
    assert "access-control-allow-origin" not in preflight(app, "GET", origin)
    answer = app.http.get("/v1/jobs", headers={"Origin": origin})
    assert "access-control-allow-origin" not in answer.headers
    assert "origin" in answer.headers["vary"].lower()  # no cache gives this answer to another page


def test_answers_and_errors_can_be_read_with_their_headers(app: ServedApp) -> None:
    made = app.http.post("/v1/captures", headers={"Origin": APP})
    assert made.headers["access-control-allow-origin"] == APP
    exposed = made.headers["access-control-expose-headers"].split(", ")
    assert {"ETag", "Location", "Retry-After", "X-Request-ID"} <= set(exposed)
    refused = app.http.get("/v1/jobs", headers={"Origin": APP, "Authorization": "Bearer wrong"})
    problem(refused, 401, "unauthorized")
    assert refused.headers["access-control-allow-origin"] == APP


def test_every_header_of_the_api_can_be_read(app: ServedApp) -> None:
    documented = {
        name
        for operations in app.asgi.openapi()["paths"].values()
        for operation in operations.values()
        for response in operation["responses"].values()
        for name in response.get("headers", {})
    }
    assert len(documented) >= 5
    assert documented - {"Set-Cookie"} <= set(EXPOSED)  # scripts read no cookies


def test_a_session_is_of_no_use_to_another_page(app: ServedApp) -> None:
    begun = app.http.post("/v1/session")
    cookie = begun.cookies[COOKIE]
    app.http.cookies.clear()
    theirs = {"Origin": APP, "Authorization": "none", "Cookie": f"{COOKIE}={cookie}"}
    problem(app.http.post("/v1/captures", headers=theirs), 403, "origin_not_allowed")


def test_a_server_without_keys_serves_the_named_pages_alone(serve: Serve) -> None:
    app = serve(cors_origins=APP)
    assert app.http.post("/v1/captures", headers={"Origin": APP}).status_code == 201
    evil = {"Origin": "https://evil.example"}
    problem(app.http.post("/v1/captures", headers=evil), 403, "origin_not_allowed")


def test_without_the_setting_no_page_of_another_origin_is_answered(serve: Serve) -> None:
    app = serve(api_key="s3cret")
    assert not [name for name in preflight(app, "GET") if name.startswith("access-control")]
    answer = app.http.get("/v1/jobs", headers={"Origin": APP})
    assert not [name for name in answer.headers if name.startswith("access-control")]


@pytest.mark.parametrize(
    "origin",
    [
        "*",
        "https://*.example.org",
        "app.example.org",
        "https://app.example.org/",
        "https://App.example.org",
        "https://app.example.org:443",
        "http://app.example.org:80",
        "https://user@app.example.org",
        "https://",
        "ftp://app.example.org",
        "null",
        "https://a b",
        "https://bücher.example",
        "https://[",
        "https://app.example.org:99999",
        "https://xn--",
    ],
)
def test_what_is_no_origin_is_refused(origin: str) -> None:
    with pytest.raises(ValidationError, match="is not an origin"):
        Settings(cors_origins=f"{APP},{origin}")


def test_origins_are_those_that_browsers_write() -> None:
    text = f"{APP},http://localhost:5173 ,https://xn--bcher-kva.example,http://[::1]:8000,,http://192.168.1.2"
    assert len(Settings(cors_origins=text).cors) == 5
