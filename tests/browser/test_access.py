"""Axe finds nothing serious on the pages of lists, sign-in and shared links, in both themes; and they work by keyboard.

The other pages have tests of their own. Axe finds what a program can find, and not whether a page makes sense.
"""

from __future__ import annotations

import pytest
from playwright.sync_api import Page, expect

from tests.browser.conftest import Open, SmallModel
from tests.support.page.axe import violations
from tests.support.up import Up

COUNT = """[...document.querySelectorAll("a[href], button, input, select, [tabindex='0']")]
  .filter((element) => element.checkVisibility()).length"""
"""The number of elements that Tab reaches."""


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_serious(service: Up, model: SmallModel, open_window: Open, scheme: str) -> None:
    page = open_window(service, color_scheme=scheme).page
    link = service.http.post(f"/v1/models/{model.id}/shares", json={"expires_in": "1h"}).json()["path"]
    for path, ready in (
        ("/jobs", "#list li"),
        ("/models", "#storage table"),
        ("/sign-in", "#already"),
        (link, ".view-bar button"),
        (f"{link}/embed", ".view-bar button"),
    ):
        page.goto(path)
        expect(page.locator(ready).first).to_be_visible()
        assert not violations(page), path
    page.goto("/models")
    page.get_by_role("button", name="Share").first.click()
    expect(page.get_by_role("dialog")).to_be_visible()
    assert not violations(page)


def test_every_control_of_the_list_is_reached_by_tab_and_is_seen_to_be(
    service: Up, model: SmallModel, page: Page
) -> None:
    page.goto("/models?name=still")
    expect(page.locator("#storage table")).to_be_visible()
    count = page.evaluate(COUNT)
    names: list[str] = []
    for _ in range(count + 2):
        page.keyboard.press("Tab")
        name, outlined = page.evaluate(
            """() => {
              const e = document.activeElement, style = getComputedStyle(e), after = getComputedStyle(e, "::after");
              const drawn = (s) => s.outlineStyle !== "none" && parseFloat(s.outlineWidth) > 0;
              return [e.outerHTML.slice(0, 80), e === document.body || drawn(style) || drawn(after)];
            }"""
        )
        assert outlined, name
        if name not in names:
            names.append(name)
    assert len([name for name in names if not name.startswith("<body")]) >= count
