"""How a model is shown to people, in a real browser: its start view with its picture, annotations and measurements are
kept with the model and shown by links and frames, and the buttons that visitors get.

Does not prove what the server keeps (tests/server/models/test_presentations.py), nor what the viewer draws
(../viewer/test_viewer.py).
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Page, expect

from tests.browser.conftest import Open, SmallModel
from tests.browser.model.test_model_page import WAIT, show
from tests.browser.viewer.test_viewer import mount, rest
from tests.support.up import Up
from tests.support.waiting import wait_for

SHOWN = """() => {
  const view = document.querySelector("#view .view");
  return Number(view?.dataset.frames) > 0 && !view.querySelector("img");
}"""
NOTHING: dict[str, Any] = {
    "start_view": None,
    "background": "black",
    "auto_rotate": False,
    "scale": None,
    "measurements": [],
    "annotations": [],
}


@pytest.fixture(autouse=True)
def _as_ever(service: Up, model: SmallModel) -> Iterator[None]:
    """Files that share the service find the model as it was."""
    # Pages load this file; until the renderer listens, it cannot be made.
    wait_for(lambda: service.http.head(f"/v1/models/{model.id}/download/sog").status_code == 200, 60)
    yield
    answer = service.http.patch(f"/v1/models/{model.id}/presentation", json=NOTHING)
    assert answer.status_code == 200, answer.text


def kept(service: Up, model: SmallModel) -> dict[str, Any]:
    return dict(service.http.get(f"/v1/models/{model.id}/presentation").json())


def link(service: Up, model: SmallModel) -> str:
    made = service.http.post(f"/v1/models/{model.id}/shares", json={"expires_in": "1h"}).json()
    return str(made["path"])


def test_visitors_begin_with_the_view_that_was_chosen(
    service: Up, model: SmallModel, open_window: Open
) -> None:
    page = open_window(service).page
    show(page, model)
    page.locator(".view").focus()
    for _ in range(4):
        page.keyboard.press("ArrowRight")
    page.get_by_role("button", name="For visitors").click()
    page.get_by_role("button", name="Begin with this view").click()
    expect(page.get_by_role("region", name="For visitors")).to_contain_text(
        "Visitors begin with this view.", timeout=WAIT
    )
    chosen = kept(service, model)["start_view"]
    visitor = open_window(service).page
    visitor.goto(link(service, model))
    picture = visitor.locator("#view img").first
    expect(picture).to_have_attribute("src", re.compile(r"/model/files/poster\.jpg$"))
    visitor.wait_for_function(SHOWN)
    visitor.evaluate("document.querySelectorAll('.view-bar, .said').forEach((element) => element.remove())")
    with Image.open(io.BytesIO(visitor.locator("#view .view").screenshot())) as shot:
        frame = shot.convert("RGB")
    answer = service.http.get(f"/v1/models/{model.id}/files/poster.jpg")
    with Image.open(io.BytesIO(answer.content)) as poster:
        scale = min(frame.width / poster.width, frame.height / poster.height)
        target = poster.convert("RGB").resize((round(poster.width * scale), round(poster.height * scale)))
    left, top = (frame.width - target.width) // 2, (frame.height - target.height) // 2
    inside = frame.crop((left, top, left + target.width, top + target.height))
    error = np.square(np.asarray(inside) / 255.0 - np.asarray(target) / 255.0).mean()
    assert -10 * math.log10(error) > 28, "the first frame is what the picture shows"
    page.reload()
    expect(page.locator("#viewer[data-ready]")).to_be_visible(timeout=WAIT)
    assert kept(service, model)["start_view"] == chosen
    page.get_by_role("button", name="For visitors").click()
    page.get_by_role("button", name="Begin with a photo's view").click()
    expect(page.get_by_role("region", name="For visitors")).to_contain_text("where a photo was taken")
    assert kept(service, model)["start_view"] is None


def drawn(page: Page) -> bool:
    """Whether anything is drawn over the view: lines and their labels."""
    over = """() => {
      const canvas = document.querySelectorAll(".view > canvas")[1];
      const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
      return data.some((value) => value > 0);
    }"""
    return bool(page.evaluate(over))


def test_measurements_and_annotations_are_kept_with_the_model(
    service: Up, model: SmallModel, open_window: Open
) -> None:
    page = open_window(service).page
    show(page, model)
    page.get_by_role("button", name="Measure").click()
    panel = page.get_by_role("form", name="Measure")
    panel.get_by_role("button", name="Keep this measurement").click()
    expect(panel.get_by_role("status")).to_contain_text("Mark two points first")
    box = page.locator(".view").bounding_box()
    assert box is not None
    for lower in (0.5, 0.65):
        before = panel.get_by_role("status").inner_text()
        page.locator(".view").click(position={"x": 0.5 * box["width"], "y": lower * box["height"]})
        expect(panel.get_by_role("status")).not_to_have_text(before, timeout=WAIT)
    panel.get_by_label("Its true length").fill("12")
    panel.get_by_role("button", name="Set the scale").click()
    expect(panel.get_by_role("status")).to_have_text("The points are 12 cm apart.", timeout=WAIT)
    panel.get_by_label("What it is").fill("the plate")
    panel.get_by_role("button", name="Keep this measurement").click()
    expect(panel.get_by_role("listitem")).to_contain_text("the plate: 12 cm", timeout=WAIT)
    page.get_by_role("button", name="Annotate").click()
    expect(panel).to_be_hidden()
    notes = page.get_by_role("form", name="Annotate")
    notes.get_by_role("button", name="Mark the point in the middle").click()
    expect(notes.get_by_label("Text")).to_be_focused(timeout=WAIT)
    page.keyboard.press("Enter")
    expect(notes.get_by_role("status")).to_have_text("Write what there is at the point.")
    expect(notes.get_by_label("Text")).to_have_attribute("aria-invalid", "true")
    page.keyboard.type("The <i>top</i>")
    page.keyboard.press("Enter")
    expect(notes.get_by_role("status")).to_contain_text("Annotation 1 is kept", timeout=WAIT)
    stored = kept(service, model)
    assert stored["scale"]["unit"] == "cm"
    assert [each["text"] for each in stored["annotations"]] == ["The <i>top</i>"]
    assert len(stored["measurements"]) == 1

    other = open_window(service).page
    show(other, model)
    expect(other.locator(".pin")).to_have_text("1")
    wait_for(lambda: drawn(other))  # from the start
    toggle = other.get_by_role("button", name="Measurements")
    expect(toggle).to_have_attribute("aria-pressed", "true")
    toggle.click()
    wait_for(lambda: not drawn(other))
    other.get_by_role("button", name="Measure", exact=True).click()
    wait_for(lambda: drawn(other))
    entry = other.get_by_role("form", name="Measure").get_by_role("listitem")
    expect(entry).to_contain_text("the plate: 12 cm")
    path = link(service, model)
    for address in (path, f"{path}/embed"):
        other.goto(address)
        other.wait_for_function(SHOWN)
        other.get_by_role("button", name="Annotation 1").click()
        expect(other.locator(".pin-text")).to_have_text("The <i>top</i>")
        expect(other.locator(".pin-text")).to_be_visible()
        marks = other.get_by_role("button", name="Measurements")
        expect(marks).to_have_attribute("aria-pressed", "true")
        wait_for(lambda: drawn(other))
        marks.click()
        expect(marks).to_have_attribute("aria-pressed", "false")
        wait_for(lambda: not drawn(other))
    show(other, model)
    other.get_by_role("button", name="Annotate").click()
    other.get_by_role("button", name="Delete annotation 1").click()
    expect(other.locator(".pin")).to_have_count(0)
    assert kept(service, model)["annotations"] == []


def test_a_double_click_turns_the_view_about_that_point(
    service: Up, model: SmallModel, open_window: Open
) -> None:
    page = open_window(service).page
    mount(page, model)
    away = page.evaluate("view.distance")
    point = page.evaluate("view.pointAt(200, 215)")
    eye = page.evaluate("view.pose.position")
    page.mouse.dblclick(200, 215)
    page.wait_for_function("(before) => view.distance !== before", arg=away)
    rest(page)
    pose, distance = page.evaluate("[view.pose, view.distance]")
    middle = [p + distance * f for p, f in zip(pose["position"], pose["forward"], strict=True)]
    assert math.dist(middle, point) < 1e-3
    assert pose["position"] == eye
    page.evaluate("view.aims = true")
    page.mouse.dblclick(100, 100)
    rest(page)
    assert page.evaluate("view.distance") == distance


def test_visitors_turn_save_and_enlarge_the_view(service: Up, model: SmallModel, open_window: Open) -> None:
    service.http.patch(f"/v1/models/{model.id}/presentation", json={"auto_rotate": True})
    page = open_window(service, reduced_motion="no-preference").page
    page.goto(f"{link(service, model)}/embed")
    page.wait_for_function(SHOWN)
    turn = page.get_by_role("button", name="Turn slowly")
    expect(turn).to_have_attribute("aria-pressed", "true")
    hint = page.locator("#view > .said")
    expect(hint).to_contain_text("double click")
    frames = int(page.locator(".view").get_attribute("data-frames") or 0)
    page.wait_for_function(
        "(n) => Number(document.querySelector('.view').dataset.frames) > n + 3", arg=frames
    )
    page.locator(".view").focus()
    page.keyboard.press("ArrowLeft")
    expect(turn).to_have_attribute("aria-pressed", "false")
    expect(hint).to_have_text("")
    page.get_by_role("button", name="How it is moved").click()
    expect(hint).to_contain_text("W A S D")
    with page.expect_download() as saved:
        page.get_by_role("button", name="Save a picture").click()
    assert saved.value.suggested_filename == "still life.png"
    with Image.open(saved.value.path()) as picture:
        assert np.asarray(picture.convert("RGB")).std() > 10
    page.get_by_role("button", name="Full screen").click()
    page.wait_for_function("() => document.fullscreenElement?.id === 'view'")
    still = open_window(service, reduced_motion="reduce").page
    still.goto(f"{link(service, model)}/embed")
    still.wait_for_function(SHOWN)
    expect(still.get_by_role("button", name="Turn slowly")).to_have_attribute("aria-pressed", "false")
