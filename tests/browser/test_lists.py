"""The lists of jobs and models over the real service: filters, pages, pictures, storage, names, the bin.

What a single job or model shows is tested with those pages.
"""

from __future__ import annotations

from datetime import datetime
from zoneinfo import ZoneInfo

from playwright.sync_api import Page, expect

from tests.browser.conftest import Open, SmallModel
from tests.support.up import Up
from tests.support.waiting import wait_for


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


def binned(service: Up) -> list[str]:
    """The ids of what is in the bin."""
    return [entry["id"] for entry in service.http.get("/v1/bin").json()["entries"]]


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
    expect(entries).to_have_count(9)
    expect(entries.filter(has_text="series 04").get_by_role("link")).to_be_focused()
    page.get_by_role("button", name="Undo").click()
    expect(entries).to_have_count(10)
    assert binned(service) == []

    page.get_by_role("button", name="Select", exact=True).click()
    for number in (1, 3, 7):
        entries.filter(has_text=f"series 0{number}").get_by_role("checkbox").check()
    page.get_by_role("button", name="Delete 3 selected").click()
    expect(entries).to_have_count(7)
    assert set(binned(service)) == {ids[1], ids[3], ids[7]}
    expect(page.get_by_role("button", name="Delete selected")).to_be_disabled()

    page.goto("/models")
    section = page.get_by_role("region", name="Bin", exact=True)
    expect(section.get_by_role("row")).to_have_count(4)
    section.get_by_role("button", name="Restore series 03").click()
    expect(section.get_by_role("row")).to_have_count(3)
    assert service.http.get(f"/v1/jobs/{ids[3]}").status_code == 200
    section.get_by_role("button", name="Delete series 07 now").click()
    page.get_by_role("button", name="Delete for good").click()
    expect(section.get_by_role("row")).to_have_count(2)
    assert service.http.get(f"/v1/jobs/{ids[7]}").status_code == 404
    assert binned(service) == [ids[1]]
    section.get_by_role("button", name="Restore series 01").click()
    expect(section).to_be_hidden()


def test_what_a_cancelled_job_left_of_a_model_leads_to_the_job(
    service: Up, model: SmallModel, page: Page
) -> None:
    (job,) = cancelled_jobs(service, model.capture, 1)
    left = service.data / "storage/models" / job / "preview.jpg"
    left.parent.mkdir(parents=True)
    left.write_bytes(b"x" * (96 << 20))  # among the largest
    wait_for(lambda: any(record["id"] == job for record in service.http.get("/v1/storage").json()["largest"]))
    page.goto("/models")
    rows = page.get_by_role("region", name="Storage").get_by_role("row")
    unfinished = rows.filter(has_text="Unfinished model")
    expect(unfinished.get_by_role("link", name="series 00")).to_have_attribute("href", f"/jobs/{job}")
    expect(rows.locator(f"a[href='/models/{model.id}']")).to_be_visible()


def test_names_and_times_are_written_alike_on_all_pages_in_any_language(
    service: Up, model: SmallModel, open_window: Open
) -> None:
    page = open_window(service, locale="de-DE", timezone_id="Asia/Tokyo").page
    body = {"capture": model.capture, "options": {"steps": 20_000}}
    job = service.http.post("/v1/jobs", json=body).json()["id"]
    service.http.post(f"/v1/jobs/{job}/cancel")
    created = datetime.fromisoformat(service.ended(job)["created_at"]).astimezone(ZoneInfo("Asia/Tokyo"))
    moment = f"{created:%b} {created.day}, {created.year}, {created:%H:%M}"
    name = f"Job {job[:8]}"
    page.goto("/jobs")
    entry = page.get_by_role("list", name="Jobs").get_by_role("listitem").filter(has_text=name)
    expect(entry.locator("time")).to_have_attribute("title", moment)
    expect(entry.get_by_role("button", name=f"Favourite: {name}")).to_be_visible()
    entry.get_by_role("link").click()
    expect(page.get_by_role("heading", level=1)).to_have_text(name)
    expect(page.locator("#facts")).to_contain_text(moment)
    made = datetime.fromisoformat(service.http.get(f"/v1/models/{model.id}").json()["created_at"])
    made = made.astimezone(ZoneInfo("Asia/Tokyo"))
    page.goto(f"/models/{model.id}")
    title = f"{made:%b} {made.day}, {made.year}, {made:%H:%M}"
    expect(page.locator("#lead time")).to_have_attribute("title", title)


def test_photos_are_deleted_and_restored(service: Up, model: SmallModel, page: Page) -> None:
    capture = service.http.post("/v1/captures", json={"name": "not needed"}).json()["id"]
    photo = b"x" * (64 << 20)  # among the largest
    assert service.http.put(f"/v1/captures/{capture}/images/a.mp4", content=photo).status_code == 201
    wait_for(
        lambda: any(record["id"] == capture for record in service.http.get("/v1/storage").json()["largest"])
    )
    page.goto("/models")
    page.get_by_role("button", name="Delete the photos not needed").click()
    row = page.get_by_role("region", name="Bin", exact=True).get_by_role("row").filter(has_text="not needed")
    expect(row).to_contain_text("Photos")
    expect(page.get_by_role("button", name="Delete the photos not needed")).to_have_count(0)
    assert binned(service) == [capture]
    # On a phone, what can be done lies within the window.
    page.set_viewport_size({"width": 390, "height": 780})
    for button in (
        *row.get_by_role("button").all(),
        page.get_by_role("button", name="Delete the photos").last,
    ):
        box = button.bounding_box()
        assert box is not None
        assert 0 <= box["x"] <= box["x"] + box["width"] <= 390
    page.get_by_role("button", name="Undo").click()
    expect(page.get_by_role("button", name="Delete the photos not needed")).to_be_visible()
    assert binned(service) == []
    assert service.http.delete(f"/v1/captures/{capture}").status_code == 204


def test_a_model_and_its_job_are_renamed(service: Up, model: SmallModel, page: Page) -> None:
    name = "<b>Vase</b> & Blumen 🌷"
    try:
        for path, address in ((f"/models/{model.id}", name), (f"/jobs/{model.id}", "again")):
            page.goto(path)
            page.get_by_role("button", name="Name and tags").click()
            field = page.get_by_role("dialog").get_by_label("Name", exact=True)
            expect(field).to_be_focused()
            field.fill(address)
            field.press("Enter")
            expect(page.get_by_role("heading", level=1)).to_have_text(address)
            expect(page.get_by_role("button", name="Name and tags")).to_be_focused()
            assert service.http.get(f"/v1/models/{model.id}").json()["name"] == address
            stored = service.http.get("/v1/storage").json()["largest"]
            assert {record["name"] for record in stored if record["id"] == model.id} == {address}
        page.get_by_role("button", name="Name and tags").click()
        page.get_by_role("dialog").get_by_role("button", name="Cancel").click()
        expect(page.get_by_role("heading", level=1)).to_have_text("again")
    finally:
        service.http.patch(f"/v1/models/{model.id}", json={"name": "still life"})
