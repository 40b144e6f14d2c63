"""What every page has: header and navigation by keyboard, both themes, phone width; and that the rules of the fixtures
bite. What the pages themselves do is tested page by page.
"""

from __future__ import annotations

import re

import pytest
from playwright.sync_api import Page, Route, expect

from splatmill_server.web.pages import PAGE
from tests.browser.conftest import Open, SmallModel, Visit
from tests.support.up import Up

PAGES = ("/", "/jobs", "/models", "/sign-in")


@pytest.mark.parametrize("path", PAGES)
def test_pages_fit_a_phone_and_have_one_heading(service: Up, open_window: Open, path: str) -> None:
    page = open_window(service, viewport={"width": 360, "height": 740}).page
    page.goto(path)
    expect(page.locator("header.bar")).to_be_visible()
    expect(page.locator("h1")).to_have_count(1)
    assert page.evaluate("document.documentElement.scrollWidth") <= 360


def test_an_unknown_address_has_a_page_for_people_and_a_problem_for_programs(visit: Visit) -> None:
    visit.watched.allow("status of 404")
    page = visit.page
    answer = page.goto("/nothing/here")
    assert answer is not None
    assert answer.status == 404
    expect(page.get_by_role("heading", level=1)).to_have_text("There is no page at this address")
    expect(page.locator("main")).to_contain_text("mistyped")
    # Scripts ask for anything, and not for HTML.
    problem = """fetch("/nothing/here").then(async (answer) => {
      const { status, code } = await answer.json();
      return [answer.status, answer.headers.get("Content-Type"), status, code];
    })"""
    assert page.evaluate(problem) == [404, "application/problem+json", 404, "not_found"]
    page.get_by_role("link", name="New scene").click()
    page.locator("html[data-ready]").wait_for()
    expect(page.get_by_role("link", name="New", exact=True)).to_have_attribute("aria-current", "page")


@pytest.mark.parametrize("width", [360, 1024])
@pytest.mark.parametrize("noun", ["jobs", "models"])
def test_the_pages_of_a_record_fit(
    service: Up, model: SmallModel, open_window: Open, noun: str, width: int
) -> None:
    page = open_window(service, viewport={"width": width, "height": 740}).page
    page.goto(f"/{noun}/{model.id}")
    expect(page.locator("#facts dd" if noun == "jobs" else "#downloads td").first).to_be_visible()
    assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_the_navigation_works_by_keyboard(page: Page) -> None:
    page.goto("/")
    expect(page.get_by_role("link", name="New")).to_have_attribute("aria-current", "page")
    page.keyboard.press("Tab")
    expect(page.get_by_role("link", name="Skip to the contents")).to_be_focused()
    for _ in range(4):
        page.keyboard.press("Tab")
    expect(page.get_by_role("link", name="Models")).to_be_focused()
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", level=1)).to_have_text("Models")
    assert page.url.endswith("/models")


def test_a_page_of_another_version_than_its_server_says_so(visit: Visit) -> None:
    visit.watched.allow("status of 404|a part that is gone")
    page = visit.page
    page.goto("/jobs")
    known = page.evaluate(
        "async () => (await import('/page/any/api.js')).get('/v1/nothing').catch((no) => no.code)"
    )
    assert known == "not_found", "its own fault"

    # The page as an older server gave it out; what it loads is the present server's.
    def older(route: Route) -> None:
        body = route.fetch().text().replace(PAGE.digest, "0" * len(PAGE.digest))
        route.fulfill(body=body, content_type="text/html")

    page.route("**/jobs", older, times=1)
    page.goto("/jobs")
    problem = """async () => {
      const { get } = await import("/page/any/api.js");
      return get("/v1/nothing").catch((no) => no.advice);
    }"""
    assert page.evaluate(problem) == "Reload the page."
    page.evaluate("setTimeout(() => { throw new TypeError('a part that is gone'); })")
    notice = page.get_by_role("status").filter(has_text="another version")
    notice.get_by_role("button", name="Reload").click()
    expect(notice).to_have_count(0)
    assert page.evaluate(problem) != "Reload the page.", "it is the present one"


def test_the_theme_follows_the_system_until_it_is_chosen(service: Up, open_window: Open) -> None:
    page = open_window(service, color_scheme="dark").page
    page.goto("/jobs")
    background = "getComputedStyle(document.body).backgroundColor"
    dark = page.evaluate(background)
    page.get_by_label("Theme").select_option("light")
    light = page.evaluate(background)
    assert dark != light
    page.goto("/models")
    assert page.evaluate(background) == light
    page.get_by_label("Theme").select_option("auto")
    assert page.evaluate(background) == dark


def test_the_engine_of_the_viewer_loads_under_the_policy(page: Page) -> None:
    page.goto("/models")
    version, names = page.evaluate("import('playcanvas').then((pc) => [pc.version, Object.keys(pc)])")
    assert version == "2.23.3"
    used = re.findall(r"\bpc\.(\w+)", (PAGE.folder / "viewer" / "splats.js").read_text())
    assert {*used} == {*names}, "server/web/bundle.mjs takes what the viewer uses"


def test_the_policy_stops_scripts_of_others(visit: Visit) -> None:
    visit.watched.allow("policy|Content Security Policy|request to another host")
    visit.page.goto("/")
    blocked = visit.page.evaluate(
        """() => new Promise((resolve) => {
             document.addEventListener("securitypolicyviolation", (e) => resolve(e.effectiveDirective), { once: true });
             const script = document.createElement("script");
             script.textContent = "globalThis.ran = true";
             document.head.append(script);
           })"""
    )
    assert blocked.startswith("script-src")
    assert visit.page.evaluate("globalThis.ran") is None
    assert visit.watched.complaints


def test_the_small_model_is_whole(service: Up, model: SmallModel) -> None:
    record = service.http.get(f"/v1/models/{model.id}").json()
    assert 100 < record["gaussians"] <= 3000
    cameras = service.http.get(f"/v1/models/{model.id}/cameras").json()["cameras"]
    assert {camera["split"] for camera in cameras} == {"train", "test"}
