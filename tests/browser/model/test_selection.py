"""The brush and the lasso of "Crop and clean" in a real browser: what is drawn is tinted, is what the server leaves
out, and can be taken out of the selection, inverted, cleared and undone, by pointer, keyboard and touch.

Not proved here: which Gaussians the renderer takes for selected (tests/worker/render_service/test_selection.py).
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Locator, Page, expect

from splatmill.schema import Selection
from splatmill_worker.render_service.selection import selected, within
from tests.browser.conftest import Open, SmallModel
from tests.browser.model.test_edit import differs, picture
from tests.browser.model.test_model_page import WAIT, show
from tests.browser.viewer.test_phone import PHONE, Fingers
from tests.support.page.axe import violations
from tests.support.page.strokes import random_strokes
from tests.support.up import Up

SELECTED = re.compile(r"^([\d,]+) of ([\d,]+) Gaussians are selected\.$")


@pytest.fixture
def panel(service: Up, page: Page, model: SmallModel) -> Locator:
    show(page, model)
    page.get_by_role("button", name="Crop and clean").click()
    return page.get_by_role("form", name="Crop and clean")


def count(panel: Locator) -> int:
    """How many Gaussians the page says are selected."""
    said = SELECTED.match(panel.locator("[aria-live]").inner_text())
    assert said is not None
    return int(said[1].replace(",", ""))


def draw(page: Page, *places: tuple[float, float]) -> None:
    """Draw a line through places, as shares of the view's width and height."""
    box = page.locator(".view").bounding_box()
    assert box is not None
    at = [(box["x"] + x * box["width"], box["y"] + y * box["height"]) for x, y in places]
    page.mouse.move(*at[0])
    page.mouse.down()
    for place in at[1:]:
        page.mouse.move(*place, steps=6)
    page.mouse.up()


AROUND = ((0.35, 0.25), (0.65, 0.25), (0.65, 0.8), (0.35, 0.8), (0.35, 0.3))


def module(page: Page) -> str:
    """The address of the page's module that decides what strokes hold."""
    addresses: str = page.evaluate(
        "performance.getEntriesByType('resource').map((entry) => entry.name)"
        ".find((name) => name.endsWith('viewer/selection.js'))"
    )
    return addresses


def test_the_page_and_the_renderer_select_the_same(panel: Locator, page: Page) -> None:
    means, strokes = random_strokes(7, gaussians=20_000, strokes=24)
    plain = [stroke.model_dump(mode="json", exclude_none=True) for stroke in strokes]
    per_stroke, masks = page.evaluate(
        """async ({ address, means, strokes }) => {
          const { within, maskOf } = await import(address);
          const centers = new Float32Array(means);
          const each = strokes.map((stroke) => ({ stroke, inside: within(centers, stroke) }));
          const masks = [false, true].map((inverted) => [...maskOf(centers.length / 3, each, inverted).mask]);
          return [each.map(({ inside }) => [...inside]), masks];
        }""",
        {"address": module(page), "means": means.ravel().tolist(), "strokes": plain},
    )
    for stroke, inside in zip(strokes, per_stroke, strict=True):
        assert inside == sorted(within(means, stroke).tolist())
    assert sum(map(len, per_stroke)) > 1000
    for inverted, mask in zip((False, True), masks, strict=True):
        chosen = selected(means, Selection(strokes=strokes, inverted=inverted))
        assert np.array_equal(np.array(mask[: len(means)]) == 255, chosen)


def test_a_lasso_is_tinted_and_is_what_the_server_leaves_out(
    service: Up, model: SmallModel, panel: Locator, page: Page
) -> None:
    panel.get_by_label("Keep only what lies in the box").uncheck()
    whole = picture(page)
    lasso = panel.get_by_role("button", name="Lasso")
    plain = lasso.evaluate("button => getComputedStyle(button).backgroundColor")
    lasso.click()
    page.mouse.move(1, 1)
    assert lasso.evaluate("button => getComputedStyle(button).backgroundColor") != plain, (
        "it is seen to be on"
    )
    draw(page, *AROUND)
    chosen = count(panel)
    page.mouse.move(1, 1)
    tinted = picture(page)
    assert differs(whole, tinted) > 0.01, "what is selected is seen"
    reddish = tinted[..., 0] - tinted[..., 2]
    height, width = reddish.shape
    middle = reddish[height // 3 : 2 * height // 3, 2 * width // 5 : 3 * width // 5]
    assert middle.mean() > (whole[..., 0] - whole[..., 2]).mean() + 0.2
    panel.get_by_label("What is left out is").select_option("hidden")
    assert differs(picture(page), tinted) > 0.02, "it is not drawn"
    asked: list[Any] = []
    page.on(
        "request", lambda request: asked.append(request.post_data_json) if "/edits" in request.url else None
    )
    panel.get_by_role("button", name="Measure what it does").click()
    expect(panel).to_contain_text("Gaussians would be left out", timeout=WAIT)
    gone = re.search(r"([\d,]+) of [\d,]+ Gaussians would be left out", panel.inner_text())
    assert gone is not None
    left_out = int(gone[1].replace(",", ""))
    assert abs(left_out - chosen) <= 2 + 0.01 * chosen, "the view draws a .sog, whose positions are rounded"
    (stroke,) = asked[0]["selection"]["strokes"]
    assert "box" not in asked[0]
    assert 3 <= len(stroke["points"]) <= 256
    panel.get_by_role("button", name="Make a new model").click()
    link = panel.get_by_role("link", name="Open the new model")
    expect(link).to_be_visible(timeout=WAIT)
    before = service.http.get(f"/v1/models/{model.id}").json()["gaussians"]
    link.click()
    expect(page.locator("#origin")).to_contain_text("without what was selected by hand")
    made = page.url.rsplit("/", 1)[1]
    assert service.http.get(f"/v1/models/{made}").json()["gaussians"] == before - left_out
    service.http.delete(f"/v1/jobs/{made}")


def test_strokes_are_taken_out_inverted_cleared_and_undone(panel: Locator, page: Page) -> None:
    crop = panel.get_by_label("Keep only what lies in the box")
    expect(crop).to_be_checked()
    panel.get_by_role("button", name="Lasso").click()
    expect(crop).not_to_be_checked()  # a box that nobody has moved is not meant
    draw(page, *AROUND)
    whole = count(panel)
    panel.get_by_role("button", name="Brush").click()
    expect(panel.get_by_role("button", name="Lasso")).to_have_attribute("aria-pressed", "false")
    panel.get_by_label("Drawing").select_option("subtract")
    draw(page, (0.5, 0.3), (0.5, 0.7))
    less = count(panel)
    assert 0 < less < whole
    panel.get_by_role("button", name="Invert").click()
    said = panel.locator("[aria-live]").inner_text()
    everything = int(said.split(" of ")[1].split(" ")[0].replace(",", ""))
    assert count(panel) == everything - less
    panel.get_by_label("Drawing").select_option("add")
    draw(page, (0.42, 0.35), (0.42, 0.7))
    assert count(panel) > everything - less, "a stroke adds to an inverted selection"
    undo = panel.get_by_role("button", name="Undo")
    undo.click()
    assert count(panel) == everything - less
    undo.click()
    assert count(panel) == less
    undo.click()
    assert count(panel) == whole
    panel.get_by_role("button", name="Clear").click()
    expect(panel).to_contain_text("Nothing is selected.")
    undo.click()
    assert count(panel) == whole
    panel.get_by_label("Only up to a distance").fill("0.000001")
    panel.get_by_role("button", name="Clear").click()
    draw(page, (0.5, 0.3), (0.5, 0.7))
    assert count(panel) == 0, "nothing is so near"


def test_the_scene_still_moves_and_clicks_turn_nothing(panel: Locator, page: Page) -> None:
    panel.get_by_role("button", name="Brush").click()
    still = picture(page)
    draw(page, (0.1, 0.1), (0.12, 0.12))
    page.mouse.dblclick(*[640, 300])
    panel.get_by_role("button", name="Clear").click()
    page.mouse.move(1, 1)
    assert differs(picture(page), still) < 1e-3, "drawing moves no camera"
    page.keyboard.down("Shift")
    draw(page, (0.4, 0.4), (0.6, 0.4))
    page.keyboard.up("Shift")
    page.mouse.move(1, 1)
    assert differs(picture(page), still) > 0.01


def test_the_keyboard_selects_too(panel: Locator, page: Page) -> None:
    button = panel.get_by_role("button", name="Select in the middle")
    button.focus()
    page.keyboard.press("Enter")
    narrow = count(panel)
    panel.get_by_label("Width of the brush").focus()
    page.keyboard.press("End")
    button.focus()
    page.keyboard.press("Space")
    assert count(panel) > narrow
    assert not violations(page)


def test_a_distance_that_is_none_selects_nothing_and_is_said(panel: Locator, page: Page) -> None:
    box, far = (
        panel.get_by_label("Keep only what lies in the box"),
        panel.get_by_label("Only up to a distance"),
    )
    far.fill("-3")
    panel.get_by_role("button", name="Select in the middle").click()
    expect(panel.locator("[aria-live]")).to_have_text("The distance is a number over 0, or left empty.")
    expect(far).to_be_focused()
    expect(far).to_have_attribute("aria-invalid", "true")
    expect(box).to_be_checked()
    panel.get_by_role("button", name="Brush").click()
    draw(page, (0.4, 0.5), (0.6, 0.5))
    expect(panel.locator("[aria-live]")).to_have_text("The distance is a number over 0, or left empty.")
    far.fill("")
    panel.get_by_role("button", name="Select in the middle").click()
    assert count(panel) > 0
    expect(far).to_have_attribute("aria-invalid", "false")


def test_a_finger_paints_and_two_move_the_scene(service: Up, model: SmallModel, open_window: Open) -> None:
    visit = open_window(service, **PHONE)
    page = visit.page
    show(page, model)
    page.get_by_role("button", name="Crop and clean").tap()
    panel = page.get_by_role("form", name="Crop and clean")
    panel.get_by_role("button", name="Brush").tap()
    page.wait_for_timeout(300)
    box = page.locator(".view").bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    fingers = Fingers(visit)
    fingers.drag((x, y), by=(60, 40))
    painted = count(panel)
    assert painted > 0
    before = picture(page)
    fingers.drag((x - 40, y), (x + 40, y), by=(0, 30), apart=20)
    assert count(panel) == painted
    assert differs(picture(page), before) > 0.005
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    assert not violations(page)
