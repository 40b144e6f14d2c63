"""Signing in with a key: the cookie, what it opens, what it does not, and signing out. The endpoints of sessions alone
are tested in tests/server/access.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import redis
from playwright.sync_api import expect

from splatmill.backplane.connection import connect
from splatmill_server.base.root_path import HEADER
from splatmill_server.base.settings import Settings
from tests.browser.conftest import Open
from tests.support.redis_server import empty_redis
from tests.support.served_app import ServedApp, served_app
from tests.support.servers.path_proxy import path_proxy


@pytest.fixture(scope="module")
def keyed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServedApp]:
    """A server with a key and a finished job; tests play the worker."""
    folder: Path = tmp_path_factory.mktemp("keyed")
    with empty_redis(folder) as url:
        connection: redis.Redis = connect(url)
        settings = Settings(redis_url=url, data=folder / "data", api_key="s3cret", reaper_interval=3600)  # type: ignore[arg-type]  # pydantic makes it a secret
        with served_app(settings, connection) as app:
            app.http.headers["Authorization"] = "Bearer s3cret"
            yield app
        connection.close()


def test_a_key_becomes_a_cookie_that_opens_everything(keyed: ServedApp, open_window: Open) -> None:
    job = keyed.job()
    visit = open_window(str(keyed.http.base_url))
    visit.watched.allow(r"status of 401")
    page = visit.page

    page.goto("/jobs?state=queued")
    expect(page).to_have_url(f"{str(keyed.http.base_url).rstrip('/')}/sign-in?next=%2Fjobs%3Fstate%3Dqueued")
    field = page.get_by_label("API key")
    expect(field).to_be_focused()
    field.fill("wrong")
    page.keyboard.press("Enter")
    expect(page.get_by_role("alert")).to_have_text(
        "The server does not know this key. It may have been revoked."
    )
    expect(field).to_be_focused()
    assert visit.context.cookies() == []

    field.fill("s3cret")
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", level=1)).to_have_text("Jobs")
    assert page.url.endswith("/jobs?state=queued")
    (cookie,) = visit.context.cookies()
    assert (cookie["httpOnly"], cookie["sameSite"]) == (True, "Strict")
    assert page.evaluate("document.cookie") == ""
    assert "s3cret" not in page.evaluate("JSON.stringify([localStorage, sessionStorage])")

    # Streams of events, which cannot carry a header, work by the cookie; so do writes from the page itself.
    first = page.evaluate(
        """(job) => new Promise((resolve) => {
             const source = new EventSource(`/v1/jobs/${job}/events`);
             source.addEventListener("state", (event) => { source.close(); resolve(JSON.parse(event.data)); });
           })""",
        job,
    )
    assert first["event"]["state"] == "queued"
    page.get_by_role("button", name="Cancel").click()
    page.get_by_role("button", name="Cancel the job").click()
    expect(page.locator(".badge")).to_have_text("Cancelled")
    assert keyed.state(job) == "cancelled"

    page.get_by_role("button", name="Sign out").click()
    expect(page.get_by_label("API key")).to_be_visible()
    assert visit.context.cookies() == []
    assert page.evaluate("fetch('/v1/jobs').then((answer) => answer.status)") == 401


def test_a_page_of_others_can_neither_write_nor_frame(keyed: ServedApp, open_window: Open) -> None:
    """The cookie is SameSite=Strict and writes check Origin: here a page of another port, with the cookie set."""
    session = keyed.http.post("/v1/session").headers["set-cookie"].partition(";")[0]
    for origin in ("http://127.0.0.1:1", "null", "https://evil.example"):
        answer = keyed.http.post(
            "/v1/captures", json={}, headers={"Cookie": session, "Origin": origin, "Authorization": ""}
        )
        assert (answer.status_code, answer.json()["code"]) == (403, "origin_not_allowed"), origin
    own = str(keyed.http.base_url).rstrip("/")
    answer = keyed.http.post(
        "/v1/captures", json={}, headers={"Cookie": session, "Origin": own, "Authorization": ""}
    )
    assert answer.status_code == 201


def test_the_way_back_stays_on_this_server(keyed: ServedApp, open_window: Open) -> None:
    visit = open_window(str(keyed.http.base_url))
    visit.watched.allow(r"status of 401")
    for elsewhere in ("//evil.example/x", "https://evil.example", "javascript:alert(1)", "/\\evil.example"):
        visit.page.goto(f"/sign-in?next={elsewhere}")
        visit.page.get_by_label("API key").fill("s3cret")
        visit.page.keyboard.press("Enter")
        expect(visit.page.get_by_role("heading", level=1)).not_to_have_text("Sign in")
        assert visit.page.url == f"{str(keyed.http.base_url).rstrip('/')}/"
        visit.page.goto("about:blank")  # else the page goes to sign in by itself once its cookie is gone
        visit.context.clear_cookies()


def test_below_a_path_a_key_opens_this_server_alone(keyed: ServedApp, open_window: Open) -> None:
    with path_proxy(keyed.address[1], strip=True, sent={HEADER: "/splats"}) as address:
        visit = open_window(address)
        visit.watched.allow(r"status of 401")
        page = visit.page
        page.goto(f"{address}/jobs")
        expect(page).to_have_url(f"{address}/sign-in?next=%2Fsplats%2Fjobs")
        page.goto(f"{address}/sign-in?next=%2Fanother-program")
        page.get_by_label("API key").fill("s3cret")
        page.keyboard.press("Enter")
        expect(page).to_have_url(f"{address}/")
        (cookie,) = visit.context.cookies()
        assert cookie["path"] == "/splats/"
        page.locator("html[data-ready]").wait_for()
        page.get_by_role("button", name="Sign out").click()
        expect(page).to_have_url(f"{address}/sign-in")
        assert visit.context.cookies() == []
