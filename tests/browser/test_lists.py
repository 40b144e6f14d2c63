"""The lists of jobs and models over the real service: filters, pages, pictures, storage, delete. What a single job or
model shows is tested with those pages.
"""

from __future__ import annotations

from playwright.sync_api import Page, expect

from tests.browser.conftest import SmallModel
from tests.support.up import Up


def cancelled_jobs(service: Up, capture: str, count: int) -> list[str]:
    """Jobs that were cancelled while they waited, or soon after; their names hold their number."""
    ids = []
    for number in range(count):
        body = {"capture": capture, "name": f"series {number:02d}", "options": {"steps": 20_000}}
        ids.append(service.http.post("/v1/jobs", json=body).json()["id"])
    for job in reversed(ids):
        service.http.post(f"/v1/jobs/{job}/cancel")
    assert {service.ended(job)["state"] for job in ids} == {"cancelled"}
    return ids


def test_a_model_is_listed_with_picture_and_figures(service: Up, model: SmallModel, page: Page) -> None:
    page.goto("/models")
    tile = page.get_by_role("list", name="Models").get_by_role("listitem").filter(has_text="still life")
    expect(tile).to_contain_text("dB")
    expect(tile).to_contain_text("Gaussians")
    expect(tile.locator("img")).to_have_js_property("complete", True)
    assert tile.locator("img").evaluate("img => img.naturalWidth") > 0
    expect(page.get_by_role("region", name="Storage")).to_contain_text("Photos")
    expect(page.get_by_role("table")).to_contain_text("still life")
    page.get_by_label("Name contains").fill("nothing like it")
    expect(page.get_by_role("status")).to_have_text("No models match. Change the filter to see others.")
    assert page.url.endswith("/models?name=nothing+like+it")
    page.get_by_label("Name contains").fill("STILL")
    expect(tile).to_be_visible()
    tile.get_by_role("link").click()
    expect(page).to_have_url(f"{str(service.http.base_url).rstrip('/')}/models/{model.id}")


def test_jobs_are_filtered_paged_and_deleted(service: Up, model: SmallModel, page: Page) -> None:
    ids = cancelled_jobs(service, model.capture, 32)
    entries = page.get_by_role("list", name="Jobs").get_by_role("listitem")
    page.goto("/jobs?name=series")
    expect(page.get_by_label("Name contains")).to_have_value("series")
    expect(entries).to_have_count(30)
    more = page.get_by_role("button", name="Show more")
    more.focus()
    page.keyboard.press("Enter")
    expect(entries).to_have_count(32)
    expect(more).to_be_hidden()
    expect(entries.nth(30).get_by_role("link")).to_be_focused()

    page.get_by_label("State").select_option("Finished")
    expect(page.get_by_role("status")).to_contain_text("No jobs match")
    page.get_by_label("State").select_option("Cancelled")
    page.get_by_label("Name contains").fill("series 0")
    expect(entries).to_have_count(10)

    chosen = entries.filter(has_text="series 05")
    chosen.get_by_role("button", name="Delete").click()
    page.get_by_role("button", name="Keep").press("Enter")
    expect(entries).to_have_count(10)
    chosen.get_by_role("button", name="Delete").click()
    page.get_by_role("dialog").get_by_role("button", name="Delete").click()
    expect(entries).to_have_count(9)
    assert service.http.get(f"/v1/jobs/{ids[5]}").status_code == 404
    expect(entries.filter(has_text="series 04").get_by_role("link")).to_be_focused()
