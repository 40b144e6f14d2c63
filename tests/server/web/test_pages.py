"""The web page over HTTP: open addresses, files under digests that may be cached for ever, compression, the policy.

Not proved here: that a browser shows it (tests/browser).
"""

from __future__ import annotations

import ast
import base64
import hashlib
import json
import re
from typing import get_args
from urllib.parse import urljoin

import httpx
import pytest

from splatmill.schema import Event
from splatmill_server.web import pages
from splatmill_server.web.tree import Tree
from tests.support.paths import ROOT
from tests.support.served_app import Serve, ServedApp, problem

PAGE = ROOT / "server/splatmill_server/web/page"

PAGES = (
    "/",
    "/jobs",
    "/jobs/0123456789abcdef",
    "/models",
    "/models/0123456789abcdef",
    "/sign-in",
    "/glossary",
)


@pytest.mark.parametrize("path", PAGES)
def test_pages_need_no_key_and_their_files_are_there(serve: Serve, path: str) -> None:
    app = serve(api_key="s3cret")
    with httpx.Client(base_url=app.http.base_url, verify=False, timeout=60) as stranger:
        answer = stranger.get(path)
        assert answer.status_code == 200
        assert answer.headers["content-type"] == "text/html; charset=utf-8"
        assert answer.headers["cache-control"] == "no-cache"
        assert stranger.head(path).status_code == 200
        links = [urljoin(path, link) for link in re.findall(r'(?:src|href)="([^"]+page/[^"]+)"', answer.text)]
        assert len(links) >= 4
        for link in links:
            file = stranger.get(link)
            assert file.status_code == 200, link
            assert file.headers["cache-control"] == "public, max-age=31536000, immutable", link


def test_what_is_below_v1_still_needs_a_key(serve: Serve) -> None:
    app = serve(api_key="s3cret")
    for path in ("/v1/models", "/metrics", "/jobs/a/b", "/page"):
        answer = httpx.get(f"{app.http.base_url}".rstrip("/") + path, verify=False, timeout=60)
        assert answer.status_code == 401, path


def test_only_the_import_map_may_run_inline(app: ServedApp) -> None:
    answer = app.http.get("/")
    policy = answer.headers["content-security-policy"]
    rules = dict(rule.split(" ", 1) for rule in policy.split("; "))
    assert rules["default-src"] == "'none'"
    assert rules["frame-ancestors"] == "'none'"
    assert "unsafe" not in policy
    assert "http" not in policy
    assert "*" not in policy
    inline = re.findall(r"<script(?: type=\"importmap\")?>(.+?)</script>", answer.text)
    digests = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in inline]
    assert rules["script-src"].split() == ["'self'", *(f"'sha256-{digest}'" for digest in digests)]
    assert not re.search(r" style=| on[a-z]+=|<style", answer.text)
    for text in inline:
        for address in json.loads(text)["imports"].values():
            if not address.endswith("/"):
                assert app.http.head(address).status_code == 200


def test_files_are_compressed_where_the_client_accepts(app: ServedApp) -> None:
    link = re.findall(r'"\.(/page/[^"]+base\.css)"', app.http.get("/").text)[0]
    plain = app.http.get(link, headers={"Accept-Encoding": "identity"})
    packed = app.http.get(link, headers={"Accept-Encoding": "br;q=1, gzip"})
    assert packed.headers["content-encoding"] == "gzip"
    assert "content-encoding" not in plain.headers
    assert packed.content == plain.content  # httpx unpacks
    assert int(packed.headers["content-length"]) < 0.5 * len(plain.content)
    assert plain.headers["vary"] == "Accept-Encoding"
    assert plain.headers["etag"] != packed.headers["etag"]
    again = app.http.get(link, headers={"Accept-Encoding": "gzip", "If-None-Match": packed.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    assert "content-encoding" not in app.http.get(link, headers={"Accept-Encoding": "gzip;q=0"}).headers


def test_another_digest_is_answered_but_not_for_ever(app: ServedApp) -> None:
    answer = app.http.get("/page/0000000000000000/base.css")
    assert (answer.status_code, answer.headers["cache-control"]) == (200, "no-cache")


@pytest.mark.parametrize("name", ["nothing.css", "%2e%2e/pages.py", "..%2fpages.py", "", "new"])
def test_nothing_else_is_served(app: ServedApp, name: str) -> None:
    problem(app.http.get(f"/page/{pages.PAGE.digest}/{name}"), 404, "not_found")


def test_a_changed_file_has_another_address(tmp_path) -> None:
    (tmp_path / "a.css").write_text("a {}")
    (tmp_path / ".hidden.css").write_text("")
    (tmp_path / "secret.py").write_text("")
    tree = Tree(tmp_path)
    first = tree.digest
    assert tree.names() == ["a.css"]
    (tmp_path / "a.css").write_text("a { color: red }")
    assert tree.digest != first
    assert not tree.is_current(first)
    assert tree.is_current(tree.digest)
    assert Tree(tmp_path / "absent").names() == []


def test_the_folder_is_looked_at_for_another_digest_and_not_for_each_file(tmp_path) -> None:
    """A page of a process that has seen a changed file gets the new one from a process that has not."""
    (tmp_path / "below").mkdir()
    (tmp_path / "below/a.css").write_text("a {}")
    tree = Tree(tmp_path)
    first = tree.digest
    (tmp_path / "below/a.css").write_text("a { color: red }")
    assert tree.is_current(first), "the files as they were read"
    before = tree.find("below/a.css")
    assert tree.is_current(Tree(tmp_path).digest)
    after = tree.find("below/a.css")
    assert before is not None
    assert after is not None
    assert before.etag != after.etag
    assert tree.names() == ["below/a.css"]


def test_without_the_packages_pages_say_what_is_missing(app: ServedApp, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(pages, "VENDOR", Tree(tmp_path / "absent"))
    answer = app.http.get("/models")
    assert '<html data-viewer="missing" ' in answer.text
    assert "importmap" not in answer.text
    assert app.http.get("/v1/models").status_code == 200


def test_every_page_has_a_place_for_what_all_heads_have_in_common() -> None:
    assert pages.HEAD.count(pages.IMPORT_MAP_HERE) == 1
    names = [name for name in pages.PAGE.names() if name.endswith(".html")]
    assert len(names) >= 6
    for name in names:
        text = (pages.PAGE.folder / name).read_text()
        assert text.count(pages.HEAD_HERE) == 1, name
        assert '<html lang="en">' in text, name


def test_people_read_no_requests_of_the_api_as_advice() -> None:
    replaced = (pages.PAGE.folder / "advice.js").read_text()
    known = set(re.findall(r"^  (\w+): \"", replaced, re.MULTILINE))
    request = re.search(r"const REQUEST = /(.+)/;", replaced)
    assert request is not None
    codes = {
        call.args[0].value
        for path in (ROOT / "server" / "splatmill_server").rglob("*.py")
        for call in ast.walk(ast.parse(path.read_text()))
        if isinstance(call, ast.Call) and call.args and isinstance(call.args[0], ast.Constant)
        for keyword in call.keywords
        if keyword.arg == "advice" and re.search(request[1].replace("\\/", "/"), ast.unparse(keyword.value))
    }
    unseen = {
        "key_not_found",
        "import_not_found",
        "webhook_not_found",
        "delivery_not_found",
    }  # no page asks for them
    assert len(codes) > 20
    assert codes - known == unseen


def test_people_see_a_page_at_an_unknown_address_and_programs_a_problem(serve: Serve) -> None:
    browser = {"Accept": "text/html,*/*"}
    keyless, keyed = serve(), serve(api_key="s3cret")
    page = keyless.http.get("/nothing/here", headers=browser)
    assert (page.status_code, page.headers["content-type"]) == (404, "text/html; charset=utf-8")
    problem(keyless.http.get("/nothing/here"), 404, "not_found")
    problem(keyless.http.get("/v1/nothing", headers=browser), 404, "not_found")
    with httpx.Client(base_url=keyed.http.base_url, timeout=60) as stranger:
        led = stranger.get("/nothing/here", headers=browser)
        assert (led.status_code, led.headers["location"]) == (303, "/sign-in?next=/nothing/here")
        problem(stranger.get("/v1/models", headers=browser), 401, "unauthorized")


def test_the_page_listens_to_all_events_of_a_job() -> None:
    (listed,) = re.findall(r"const types = (\[.*\]);", (PAGE / "api.js").read_text())
    kinds = [get_args(kind.model_fields["type"].annotation) for kind in get_args(get_args(Event)[0])]
    assert sorted(json.loads(listed)) == sorted(name for (name,) in kinds)
