"""A server below a path of its host: by a proxy that strips the path from what it passes on, by one that keeps it, and
by one that names it in a header. Every address in an answer leads through the proxy.

Not proved here: that a browser shows the pages (tests/browser/test_root_path.py), nor the proxies' own settings, which
docs/serving.md has.
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Iterator
from contextlib import contextmanager
from http.cookies import SimpleCookie
from pathlib import Path
from typing import Any
from urllib.parse import urljoin

import httpx
import pytest
import structlog
from pydantic import ValidationError

from splatmill.sdk.client import Client
from splatmill.transfer.chunked_uploads import PIECE
from splatmill_server.access.sessions import COOKIE
from splatmill_server.base.root_path import HEADER, OWN_PATHS, checked
from splatmill_server.base.settings import Settings
from splatmill_server.web import pages
from tests.support.served_app import Serve, ServedApp, problem
from tests.support.servers.path_proxy import path_proxy
from tests.support.waiting import wait_for

PUBLISHED = [
    pytest.param({"root_path": "/splats"}, {"strip": True}, id="stripped"),
    pytest.param({"root_path": "/splats"}, {"strip": False}, id="kept"),
    pytest.param({"root_path": "/splats/"}, {"strip": True, "host": False}, id="stripped, another Host"),
    pytest.param({}, {"strip": True, "sent": {HEADER: "/splats"}}, id="stripped, named in a header"),
    pytest.param({}, {"strip": False, "sent": {HEADER: "/splats/"}}, id="kept, named in a header"),
]
"""Settings of the server, and how the proxy before it passes on requests."""

MISSED = re.compile(rf"/({'|'.join(map(re.escape, OWN_PATHS))})(/|$)")
"""An address that does not lead through the proxy."""


@contextmanager
def published(app: ServedApp, **proxy: Any) -> Iterator[httpx.Client]:
    """A client of the app through a proxy under /splats. Each answer's addresses are checked to lead through it."""

    def check(answer: httpx.Response) -> None:
        answer.read()
        named = [answer.headers["location"]] if "location" in answer.headers else []
        if answer.headers.get("content-type", "").endswith("json"):
            named += texts(answer.json())
        for text in named:
            assert not MISSED.match(text), f"{text} misses the proxy"

    with path_proxy(app.address[1], **proxy) as base:
        headers = {"Authorization": app.http.headers.get("Authorization", "none")}
        hooks = {"response": [check]}
        with httpx.Client(
            base_url=base, headers=headers, event_hooks=hooks, timeout=20, verify=False
        ) as http:
            yield http


def texts(node: Any) -> list[str]:
    """All texts in a JSON document but those of the OpenAPI document, whose paths are below its `servers`."""
    if isinstance(node, dict):
        return [] if "openapi" in node else [text for value in node.values() for text in texts(value)]
    if isinstance(node, list):
        return [text for value in node for text in texts(value)]
    return [node] if isinstance(node, str) else []


def followed(http: httpx.Client, answer: httpx.Response, address: str) -> httpx.Response:
    """What an address in an answer leads to, as a client finds it that knows URLs only."""
    return http.get(urljoin(str(answer.url), address))


@pytest.mark.parametrize(("settings", "proxy"), PUBLISHED)
def test_every_address_in_an_answer_leads_through_the_proxy(
    serve: Serve, settings: dict[str, Any], proxy: dict[str, Any]
) -> None:
    app = serve(api_key="s3cret", renderer_url="http://127.0.0.1:9", outgoing_allow="127.0.0.1:9", **settings)
    with published(app, **proxy) as http:
        made = http.post("/v1/captures", json={"name": "garden"})
        capture = followed(http, made, made.headers["location"]).json()["id"]
        assert capture == made.json()["id"]
        for name in ("a.jpg", "b.jpg"):
            photo = f"/v1/captures/{capture}/images/{name}"
            assert http.put(photo, content=b"\xff\xd8\xff" + name.encode()).status_code == 201
        begun = http.put(
            f"/v1/captures/{capture}/images/c.jpg", headers={"Upload-Complete": "?0", "Upload-Length": "9"}
        )
        upload = urljoin(str(begun.url), begun.headers["location"])
        assert http.head(upload).headers["upload-offset"] == "0"
        imported = http.post(
            f"/v1/captures/{capture}/import", json={"url": "http://127.0.0.1:9/d.jpg", "name": "d.jpg"}
        )
        assert imported.status_code == 202, imported.text
        assert followed(http, imported, imported.headers["location"]).json()["id"] == imported.json()["id"]

        queued = http.post("/v1/jobs", json={"capture": capture})
        job = queued.json()["id"]
        for listed in (queued.json(), http.get("/v1/jobs").json()["jobs"][0]):
            assert followed(http, queued, listed["links"]["self"]).json()["id"] == job
            assert followed(http, queued, listed["links"]["capture"]).json()["id"] == capture
        app.begin(job)
        app.finish(job)
        shown = http.get(f"/v1/models/{job}")
        for name in ("self", "job", "cameras", "formats", "ply", "report", "orbits", "meshes"):
            assert followed(http, shown, shown.json()["links"][name]).status_code == 200, name
        formats = http.get(f"/v1/models/{job}/formats")
        assert followed(http, formats, formats.json()["formats"][0]["address"]).content.startswith(b"ply")
        orbit = http.post(f"/v1/models/{job}/orbits", json={})
        assert orbit.status_code == 202, orbit.text
        assert followed(http, orbit, orbit.json()["links"]["self"]).json()["id"] == orbit.json()["id"]
        mesh = http.post(f"/v1/models/{job}/meshes", json={})
        assert followed(http, mesh, mesh.json()["links"]["self"]).json()["id"] == mesh.json()["id"]

        share = http.post(f"/v1/models/{job}/shares")
        assert share.headers["location"] == share.json()["path"]
        page = followed(http, share, share.json()["path"])
        assert page.status_code == 200
        if proxy.get("host", True):
            assert f'content="{http.base_url}s/' in page.text  # the picture for messengers, with a host
        model = http.get(f"{page.url}/model/formats")
        assert followed(http, model, model.json()["formats"][0]["address"]).content.startswith(b"ply")

        for path, body in (
            ("/v1/keys", {"name": "ann", "owner": "ann"}),
            ("/v1/webhooks", {"url": "http://127.0.0.1:9/", "events": ["job.succeeded"]}),
        ):
            record = http.post(path, json=body)
            assert record.status_code == 201, record.text
            assert record.headers["location"].startswith("/splats" + path)
        assert http.get("/v1/nothing").json()["instance"] == "/splats/v1/nothing"
        assert http.get("/openapi.json").json()["servers"] == [{"url": "/splats"}]
        docs = http.get("/docs")
        assert followed(http, docs, re.findall('href="(.+?)"', docs.text)[0]).json()["paths"]
        slash = http.get("/jobs/")
        assert followed(http, slash, slash.headers["location"]).text.startswith("<!doctype")


@pytest.mark.parametrize("settings", [{}, {"root_path": "/splats"}])
@pytest.mark.parametrize(
    "path", ["/", "/jobs", "/jobs/0123456789abcdef", "/sign-in", "/s/a-token", "/s/a-token/embed"]
)
def test_a_page_finds_its_files_below_any_path(serve: Serve, settings: dict[str, str], path: str) -> None:
    app = serve(**settings)
    # Without the setting, the server does not know the path.
    with published(app, strip=True) as http:
        page = http.get(path)
        named = re.findall(r'(?:src|href)="([^"#]+)"', page.text)
        mapped = re.findall(r'<script type="importmap">(.+?)</script>', page.text)
        named += [address for text in mapped for address in json.loads(text)["imports"].values()]
        assert len(named) >= 4
        for address in named:
            url = urljoin(str(page.url), address)
            assert url.startswith(str(http.base_url))
            if not url.endswith("/") or url == str(http.base_url):  # a map names folders, too
                assert http.get(url).status_code == 200, address


def test_a_path_named_by_a_stranger_is_not_believed(serve: Serve) -> None:
    app = serve(forwarded_allow_ips="192.0.2.1")
    with path_proxy(app.address[1], strip=True, sent={HEADER: "/splats"}) as base:
        assert httpx.post(f"{base}/v1/captures", timeout=60).headers["location"].startswith("/v1/captures/")
    configured = serve(root_path="/own")
    with path_proxy(configured.address[1], "/own", strip=True, sent={HEADER: "/evil"}) as base:
        assert (
            httpx.post(f"{base}/v1/captures", timeout=60).headers["location"].startswith("/own/v1/captures/")
        )


@pytest.mark.parametrize(
    "path",
    ["splats", "//evil.example", "/a//b", "/../v1", "/a b", '/"><script>', "/a,/b", "/v1", "/s/x", "/é"],
)
def test_a_header_that_names_no_path_is_refused(app: ServedApp, path: str) -> None:
    for address in ("/", "/v1/jobs", "/healthz"):
        answer = app.http.get(address, headers={HEADER.encode(): path.encode()})
        assert HEADER in problem(answer, 422, "invalid_request")["detail"]
    with pytest.raises(ValidationError, match="/splats"):
        Settings(root_path=path)


def test_paths_are_taken_as_they_are_written() -> None:
    assert [checked(text) for text in ("", "/", "/splats/", "/a/b-c/~d.e")] == [
        "",
        "",
        "/splats",
        "/a/b-c/~d.e",
    ]


def test_the_servers_own_paths_are_known(app: ServedApp) -> None:
    routes = [str(getattr(route, "path", "/")) for route in (*app.asgi.routes, *pages.router.routes)]
    first = {path.split("/")[1] for path in (*app.asgi.openapi()["paths"], *routes, "/docs")}
    assert first - {""} == OWN_PATHS


def test_what_a_key_is_asked_for_does_not_depend_on_the_path(serve: Serve) -> None:
    app = serve(api_key="s3cret", root_path="/splats")
    for address in ("/splats/v1/jobs", "/v1/jobs", "/splats/splats/", "/splatsv1/jobs", "/splats//v1/jobs"):
        assert httpx.get(f"http://127.0.0.1:{app.address[1]}{address}", timeout=60).status_code == 401, (
            address
        )
    for address in ("/splats", "/splats/", "/", "/splats/jobs", "/splats/healthz"):
        answer = httpx.get(f"http://127.0.0.1:{app.address[1]}{address}", follow_redirects=True, timeout=60)
        assert answer.status_code == 200, address
    # The size of a body is limited, but for files.
    large = b"0" * (app.settings.max_json_bytes + 1)
    problem(app.http.post("/splats/v1/captures", content=large), 413, "body_too_large")
    capture = app.capture()
    assert app.http.put(f"/splats/v1/captures/{capture}/images/large.jpg", content=large).status_code == 201


def test_a_session_belongs_to_the_path(serve: Serve) -> None:
    app = serve(api_key="s3cret", root_path="/splats")
    with published(app, strip=True) as http:
        begun = http.post("/v1/session")
        cookie = SimpleCookie(begun.headers["set-cookie"])[COOKIE]
        assert cookie["path"] == "/splats/"
        here = {
            "Authorization": "none",
            "Cookie": f"{COOKIE}={cookie.value}; {COOKIE}=of-another-server-at-the-root",
        }
        assert http.get("/v1/me", headers=here).status_code == 200
        ended = http.delete("/v1/session", headers=here | {"Sec-Fetch-Site": "same-origin"})
        assert SimpleCookie(ended.headers["set-cookie"])[COOKIE]["path"] == "/splats/"
        assert http.get("/v1/me", headers=here).status_code == 401


def test_a_page_may_write_where_the_proxy_has_replaced_the_host(app: ServedApp) -> None:
    with path_proxy(app.address[1], strip=True, host=False) as base:
        origin = base.removesuffix("/splats")
        sent = {"Origin": origin, "Sec-Fetch-Site": "same-origin"}
        assert httpx.post(f"{base}/v1/captures", headers=sent, timeout=60).status_code == 201
        for site in ("same-site", "cross-site"):
            answer = httpx.post(f"{base}/v1/captures", headers=sent | {"Sec-Fetch-Site": site}, timeout=60)
            problem(answer, 403, "origin_not_allowed")


def test_the_log_shows_no_token(serve: Serve) -> None:
    app = serve(root_path="/splats", access_log=True)
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.INFO))
    with structlog.testing.capture_logs() as lines:
        app.http.get("/splats/s/a-secret-token/model")
        wait_for(
            lambda: any(line["event"] == "request" for line in lines)
        )  # it is written after the response
    paths = [line["path"] for line in lines if line["event"] == "request"]
    assert paths == ["/s/.../model"]


@pytest.mark.parametrize(
    ("settings", "proxy"), [PUBLISHED[0].values, PUBLISHED[1].values, ({}, {"strip": True})]
)
def test_the_sdk_works_through_the_proxy(
    serve: Serve, settings: dict[str, str], proxy: dict[str, Any], tmp_path: Path
) -> None:
    app = serve(**settings)
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "large.jpg").write_bytes(b"\xff\xd8\xff" + b"0" * (PIECE + 10))
    with path_proxy(app.address[1], **proxy) as base, Client(base) as client:
        capture, _ = client.upload(photos)  # in pieces, to the address in Location
        assert [file.size for file in client.capture(capture.id).files] == [PIECE + 13]
