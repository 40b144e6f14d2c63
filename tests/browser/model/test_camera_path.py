"""The camera path of a model's page in a real browser: views are added, kept and drawn, and a video follows them.

Does not prove the way between the views (tests/client/schema/test_videos.py).
"""

from __future__ import annotations

from typing import Any

import pytest
from playwright.sync_api import expect

from tests.browser.conftest import Open, SmallModel
from tests.browser.model.test_model_page import WAIT, show
from tests.support.up import Up


def test_a_path_is_put_together_kept_and_followed_by_a_video(
    service: Up, model: SmallModel, open_window: Open
) -> None:
    address = f"/v1/models/{model.id}"

    def kept() -> dict[str, Any] | None:
        path: dict[str, Any] | None = service.http.get(f"{address}/presentation").json()["camera_path"]
        return path

    page = open_window(service).page
    show(page, model)
    card = page.locator("#orbit")
    card.get_by_label("The camera").select_option("path")
    card.get_by_role("button", name="Make the video").click()
    expect(card).to_contain_text("There is no camera path yet")
    tool = page.get_by_role("button", name="Camera path", exact=True)
    expect(tool).to_be_focused()
    tool.click()
    panel = page.get_by_role("region", name="Camera path")
    add = panel.get_by_role("button", name="Add this view")
    add.click()
    expect(panel).to_contain_text("A path has two views at least.")
    for _ in range(2):
        page.locator(".view").focus()
        for _ in range(4):
            page.keyboard.press("ArrowRight")
        add.click()
    expect(panel.get_by_role("listitem")).to_have_count(3)
    page.wait_for_function(
        "(a) => fetch(a).then((r) => r.json()).then((p) => p.camera_path?.keyframes.length === 3)",
        arg=f"{address}/presentation",
        timeout=WAIT,
    )
    panel.get_by_label("Lead back to the first view").check()
    page.wait_for_function(
        "(a) => fetch(a).then((r) => r.json()).then((p) => p.camera_path?.closed)",
        arg=f"{address}/presentation",
    )
    frames = int(page.locator(".view").get_attribute("data-frames") or 0)
    panel.get_by_role("button", name="Play", exact=True).click()
    page.wait_for_function(
        "(n) => Number(document.querySelector('.view').dataset.frames) > n + 3", arg=frames
    )
    path = kept()
    assert path is not None
    page.reload()
    expect(page.locator("#viewer[data-ready]")).to_be_visible(timeout=WAIT)
    page.get_by_role("button", name="Camera path", exact=True).click()
    panel.get_by_role("button", name="Delete view 3").click()
    expect(panel.get_by_role("listitem")).to_have_count(2)
    page.wait_for_function(
        "(a) => fetch(a).then((r) => r.json()).then((p) => p.camera_path?.keyframes.length === 2)",
        arg=f"{address}/presentation",
    )
    card.get_by_label("The camera").select_option("path")
    card.get_by_label("Length, in seconds").fill("90")
    card.get_by_role("button", name="Make the video").click()
    expect(card).to_contain_text("0.5 to 60 seconds")
    card.get_by_label("Length, in seconds").fill("0.5")
    card.get_by_role("button", name="Make the video").click()
    expect(card.locator("video")).to_be_visible(timeout=2 * WAIT)
    made = service.http.get(f"{address}/orbits").json()["orbits"]
    assert [each["request"]["camera_path"]["closed"] for each in made] == [True]
    assert made[0]["request"]["camera_path"]["keyframes"] == path["keyframes"][:2]
    assert made[0]["request"]["seconds"] == pytest.approx(0.5)
    service.http.delete(f"{address}/orbits/{made[0]['id']}")
    service.http.patch(f"{address}/presentation", json={"camera_path": None})
