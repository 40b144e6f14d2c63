"""Pages on a phone, by real touches: one finger scrolls the page over a view until the view is entered, the downloads
can be read, and the view stays in sight while its tools are used.

Not proved here: other browsers' ways to scroll. tests/browser/new/test_new_phone.py tests the page that takes photos.
"""

from __future__ import annotations

from typing import Any

import pytest
from playwright.sync_api import CDPSession, Page, expect

from tests.browser.conftest import Open, SmallModel, Visit
from tests.support.up import Up
from tests.support.waiting import wait_for

WAIT = 60_000
PHONE = {"viewport": {"width": 390, "height": 780}, "has_touch": True, "is_mobile": True}


@pytest.fixture
def phone(service: Up, model: SmallModel, open_window: Open) -> Visit:
    """A phone that shows the page of the model."""
    # The renderer of a service that has just been started may not answer yet.
    wait_for(lambda: service.http.get(f"/v1/models/{model.id}/download/sog", timeout=120).is_success)
    visit = open_window(service, **PHONE)
    visit.page.goto(f"/models/{model.id}")
    expect(visit.page.locator("#viewer[data-ready]")).to_be_visible(timeout=WAIT)
    return visit


AT_REST = "() => { still = scrollY === last ? still + 1 : 0; last = scrollY; return still > 20; }"
"""Whether the page has come to rest: a finger that is lifted leaves it in motion."""


class Fingers:
    """Touches of a page, as the browser gets them from its screen."""

    def __init__(self, visit: Visit) -> None:
        self.session: CDPSession = visit.context.new_cdp_session(visit.page)
        self.page = visit.page

    def drag(self, *starts: tuple[float, float], by: tuple[float, float], apart: float = 0.0) -> None:
        """Put fingers down at points, move them all by (x, y) pixels and each pair apart, and lift them."""
        steps = 12

        def touches(share: float) -> list[dict[str, Any]]:
            return [
                {
                    "x": x + share * (by[0] + (apart if index else -apart)),
                    "y": y + share * by[1],
                    "id": index,
                }
                for index, (x, y) in enumerate(starts)
            ]

        self._send("touchStart", touches(0))
        for step in range(1, steps + 1):
            self._send("touchMove", touches(step / steps))
        self._send("touchEnd", [])
        self.page.evaluate("globalThis.still = 0; globalThis.last = -1")
        self.page.wait_for_function(AT_REST, polling="raf")

    def _send(self, kind: str, touches: list[dict[str, Any]]) -> None:
        self.session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": touches})


def middle(page: Page, selector: str = ".view") -> tuple[float, float]:
    box = page.locator(selector).bounding_box()
    assert box is not None
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def frames(page: Page) -> str:
    """How many frames the view has drawn: none is drawn while the camera rests."""
    return str(page.locator(".view").get_attribute("data-frames"))


def scrolled(page: Page) -> float:
    return float(page.evaluate("scrollY"))


def test_one_finger_scrolls_the_page_until_the_view_is_entered(phone: Visit) -> None:
    page, fingers = phone.page, Fingers(phone)
    hint, leave = page.get_by_text("Tap to move the scene"), page.get_by_role("button", name="Done")
    expect(hint).to_be_visible()
    fingers.drag(middle(page), by=(0, -150))
    assert scrolled(page) > 80
    page.evaluate("scrollTo(0, 0)")

    # Two fingers move the scene, not the page.
    x, y = middle(page)
    fingers.drag((x - 40, y), (x + 40, y), by=(0, -60), apart=40)
    assert scrolled(page) == 0

    page.locator(".view").tap()
    expect(hint).to_be_hidden()
    place, before = scrolled(page), frames(page)
    fingers.drag(middle(page), by=(0, -150))
    assert scrolled(page) == place
    page.wait_for_function(
        "(before) => document.querySelector('.view').dataset.frames !== before", arg=before
    )

    leave.tap()
    expect(leave).to_be_hidden()
    fingers.drag(middle(page), by=(0, -150))
    assert scrolled(page) > place + 80


def test_a_touch_beside_the_view_leaves_it(phone: Visit) -> None:
    page = phone.page
    page.locator(".view").tap()
    expect(page.get_by_role("button", name="Done")).to_be_visible()
    page.locator("#lead").tap(position={"x": 2, "y": 2})
    expect(page.get_by_role("button", name="Done")).to_be_hidden()


def test_the_view_stays_in_sight_while_the_scene_is_cropped(phone: Visit) -> None:
    page = phone.page
    page.get_by_role("button", name="Crop and clean").tap()
    panel = page.get_by_role("form", name="Crop and clean")
    last = panel.get_by_role("button", name="Make a new model")
    last.scroll_into_view_if_needed()
    view, button = page.locator("#viewer").bounding_box(), last.bounding_box()
    assert view is not None
    assert button is not None
    assert view["y"] >= 0, "the whole view is in sight"
    assert view["y"] + view["height"] <= button["y"], "and covers no part of the tool that is used"
    assert button["y"] + button["height"] <= 780


def test_a_tool_is_brought_into_sight_when_it_is_opened(phone: Visit) -> None:
    page = phone.page
    page.get_by_role("button", name="Measure").tap()
    expect(page.get_by_role("heading", name="Measure", exact=True)).to_be_in_viewport()


def test_visitors_are_told_of_touches_in_one_line_until_the_first(
    service: Up, model: SmallModel, open_window: Open
) -> None:
    path = service.http.post(f"/v1/models/{model.id}/shares", json={"expires_in": "1h"}).json()["path"]
    for address in (path, f"{path}/embed"):
        visit = open_window(service, **PHONE)
        page = visit.page
        page.goto(address)
        hint = page.locator("#view > .said")
        expect(hint).to_have_text("Tap and drag to turn, pinch to zoom.")
        box = hint.bounding_box()
        assert box is not None
        assert box["height"] < 40, "a line"
        page.locator(".view[data-frames]").wait_for()
        Fingers(visit).drag(middle(page), by=(0, -60))
        expect(hint).to_be_empty()
        expect(page.locator(".view .enter")).to_be_hidden()
        page.get_by_role("button", name="How it is moved").tap()
        expect(hint).to_contain_text("Pinch: nearer and farther.")
        expect(hint).not_to_contain_text("W A S D")


def test_downloads_can_be_read_on_a_phone(phone: Visit) -> None:
    page = phone.page
    section = page.locator("#downloads")
    row = section.get_by_role("row").filter(has=page.get_by_role("link", name="SOG, version 2"))
    expect(row.get_by_role("cell").nth(2)).to_contain_text("dB", timeout=WAIT)
    assert section.evaluate("(one) => one.scrollWidth <= one.clientWidth")
    boxes = [cell.bounding_box() for cell in row.get_by_role("cell").all()]
    file, size, psnr = [box for box in boxes if box is not None]
    assert file["width"] > 300, "a line holds many words"
    assert min(size["y"], psnr["y"]) >= file["y"] + file["height"], "the figures stand below"
    assert max(size["height"], psnr["height"]) < 30, "and are not broken"
