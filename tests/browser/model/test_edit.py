"""Crop and clean on the page of a model in a real browser: what the view shows of an edit before it is made, the
handles of the box, units, and going back.

Does not prove what an edit keeps (tests/worker/render_service/test_edit.py), nor how the page asks for one
(test_model_page.py).
"""

from __future__ import annotations

import io
import re
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image
from playwright.sync_api import Locator, Page, Route, expect

from tests.browser.conftest import SmallModel, Visit
from tests.browser.model.test_model_page import WAIT, show
from tests.support.up import Up


@pytest.fixture
def panel(service: Up, page: Page, model: SmallModel) -> Locator:
    show(page, model)
    page.get_by_role("button", name="Crop and clean").click()
    return page.get_by_role("form", name="Crop and clean")


def picture(page: Page) -> npt.NDArray[np.float64]:
    """The view at rest without what is drawn over it: two pictures of it in a row are the same."""
    before = None
    for _ in range(40):
        page.evaluate(
            "document.querySelectorAll('.handles').forEach((each) => { each.style.visibility = 'hidden'; })"
        )
        with Image.open(io.BytesIO(page.locator(".view").screenshot())) as shot:
            now = np.asarray(shot.convert("RGB")) / 255.0
        page.evaluate(
            "document.querySelectorAll('.handles').forEach((each) => { each.style.visibility = ''; })"
        )
        if before is not None and np.array_equal(before, now):
            return now
        before = now
        page.wait_for_timeout(300)
    raise AssertionError("the view does not come to rest")


def differs(a: npt.NDArray[np.float64], b: npt.NDArray[np.float64]) -> float:
    return float(np.abs(a - b).mean())


def test_the_view_shows_what_is_left_out(panel: Locator, page: Page) -> None:
    tool = page.get_by_role("button", name="Crop and clean")
    tool.click()
    closed = picture(page)
    tool.click()
    look = panel.get_by_label("What is left out is")
    look.select_option("shown")
    panel.get_by_label("Keep only what lies in the box").uncheck()
    whole = picture(page)
    look.select_option("hidden")
    assert differs(picture(page), whole) < 1e-3, "nothing is left out yet"
    panel.get_by_label("Least opacity").fill("0.9")
    clear = picture(page)
    assert clear.mean() < 0.8 * whole.mean(), "what is left out is not drawn"
    look.select_option("dimmed")
    assert differs(picture(page), clear) > 0.01
    panel.get_by_label("Least opacity").fill("0")
    panel.get_by_label("Largest size").fill("0.0001")
    look.select_option("hidden")
    assert picture(page).mean() < 0.05, "all are larger"
    panel.get_by_label("Largest size").fill("")
    panel.get_by_label("Keep only what lies in the box").check()
    assert picture(page).mean() > 0.95 * whole.mean(), "the first box does not cut the scene"
    ends = [panel.get_by_label(f"The box along x, {end}") for end in ("from", "to")]
    ends[0].fill(str(sum(float(end.input_value()) for end in ends) / 2))
    ends[0].press("Tab")
    assert picture(page).mean() < 0.95 * whole.mean(), "what lies outside is not drawn"
    tool.click()
    assert differs(picture(page), closed) < 1e-3, "the tool leaves the view as it was"


def test_what_makes_the_new_model_is_in_sight_with_what_it_does(panel: Locator, page: Page) -> None:
    def in_window(element: Locator) -> bool:
        box = element.bounding_box()  # in a window of 1280 by 800 pixels
        return box is not None and 0 <= box["y"] <= box["y"] + box["height"] <= 800

    make = panel.get_by_role("button", name="Make a new model")
    panel.get_by_role("heading").scroll_into_view_if_needed()
    assert in_window(make)
    assert in_window(panel.get_by_role("heading", name="Crop and clean")), (
        "the form's beginning is in sight too"
    )
    panel.get_by_label("Least opacity").fill("0.2")
    panel.get_by_label("Keep only what lies in the box").uncheck()
    panel.get_by_role("button", name="Measure what it does").click()
    said = panel.get_by_role("status")
    expect(said).to_contain_text(
        re.compile(r"Gaussians would be left out, and [\d,]+ would stay:"), timeout=WAIT
    )
    gone, before, rest = (
        int(n.replace(",", "")) for n in re.findall(r"\d[\d,]*(?![.\d])", said.inner_text())[:3]
    )
    assert gone + rest == before
    assert in_window(said)
    # What the keyboard reaches is not below the foot.
    for field in ("Largest size", "What is left out is"):
        panel.get_by_label(field).focus()
        box, foot = panel.get_by_label(field).bounding_box(), panel.locator(".foot").bounding_box()
        assert box is not None
        assert foot is not None
        assert box["y"] + box["height"] <= foot["y"]


def test_the_axes_of_an_upright_model_have_words_that_hold_from_all_sides(
    service: Up, model: SmallModel, page: Page
) -> None:
    def with_frame(route: Route) -> None:
        answer = route.fetch()
        body = answer.json()
        body["files"].append({"name": "frame.json", "size": 2})
        route.fulfill(response=answer, json=body)

    page.route(f"**/v1/models/{model.id}", with_frame)
    show(page, model)
    page.get_by_role("button", name="Crop and clean").click()
    legends = page.get_by_role("form", name="Crop and clean").locator(".box-ends legend")
    expect(legends).to_have_text(["x, level", "y, downwards", "z, level"])


def test_the_box_is_moved_by_its_handles_and_back(panel: Locator, page: Page) -> None:
    ends = {end: panel.get_by_label(f"The box along x, {end}") for end in ("from", "to")}
    first = {end: float(field.input_value()) for end, field in ends.items()}
    undo = panel.get_by_role("button", name="Undo")
    expect(undo).to_be_disabled()
    handle = page.get_by_role("button", name="Side of the box at the end of x")
    handle.focus()
    page.keyboard.press("ArrowLeft")
    after = float(ends["to"].input_value())
    assert first["from"] < after < first["to"]
    box = handle.bounding_box()
    assert box is not None
    middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] + 40, middle[1] + 40, steps=4)
    page.mouse.up()
    dragged = float(ends["to"].input_value())
    assert dragged != after
    assert float(ends["from"].input_value()) == first["from"], "the other side stays"
    undo.click()
    assert float(ends["to"].input_value()) == after
    undo.click()
    assert float(ends["to"].input_value()) == first["to"]
    expect(undo).to_be_disabled()
    ends["from"].fill(str(first["to"] + 1))
    ends["from"].press("Tab")
    assert float(ends["from"].input_value()) == first["to"], "a box has no side of less than nothing"


def test_a_box_that_holds_nothing_is_refused_beside_its_button(
    service: Up, panel: Locator, page: Page, visit: Visit
) -> None:
    visit.watched.allow("status of 422")
    models = service.http.get("/v1/models").json()["models"]
    ends = [panel.get_by_label(f"The box along x, {end}") for end in ("from", "to")]
    ends[0].fill(ends[1].input_value())
    ends[0].press("Tab")
    expect(panel.get_by_role("status")).to_have_text("Give the box along x as two different numbers.")
    for end, far in zip(reversed(ends), ("100002", "100001"), strict=True):
        end.fill(far)
        end.press("Tab")
    panel.get_by_role("button", name="Make a new model").click()
    said = panel.get_by_role("status")
    expect(said).to_contain_text("The edit leaves no Gaussian of the model.", timeout=WAIT)
    expect(said).to_contain_text("Choose a larger box, a lower opacity or a larger size.")
    expect(panel.get_by_role("button", name="Make a new model")).to_be_enabled()
    assert service.http.get("/v1/models").json()["models"] == models


def test_lengths_are_in_the_unit_of_the_model(service: Up, page: Page, model: SmallModel) -> None:
    address = f"/v1/models/{model.id}/presentation"
    service.http.patch(address, json={"scale": {"factor": 10, "unit": "cm"}})
    try:
        show(page, model)
        page.get_by_role("button", name="Crop and clean").click()
        panel = page.get_by_role("form", name="Crop and clean")
        expect(panel).to_contain_text("Lengths are in cm.")
        panel.get_by_label("Largest size, in cm").fill("5")
        low = float(panel.get_by_label("The box along y, from").input_value())
        asked: list[Any] = []
        page.on(
            "request",
            lambda request: asked.append(request.post_data_json) if "/edits" in request.url else None,
        )
        panel.get_by_role("button", name="Measure what it does").click()
        expect(panel.get_by_role("status")).to_contain_text("left out", timeout=WAIT)
        assert asked[0]["max_size"] == pytest.approx(0.5)
        assert asked[0]["box"]["min"][1] == pytest.approx(low / 10, rel=1e-3)
    finally:
        service.http.patch(address, json={"scale": None})
