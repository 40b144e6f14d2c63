"""Names, tags, stars and the order of the lists, as people set them: by keyboard, on a phone, over a reload.

Not proved here: that labels outlast Redis, and which lists hold what (tests/server/jobs/test_labels.py).
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from playwright.sync_api import Locator, Page, expect

from splatmill.schema.resources.jobs.labels import MOST_TAGS
from tests.browser.conftest import Open, SmallModel
from tests.browser.test_lists import cancelled_jobs
from tests.support.page.axe import violations
from tests.support.up import Up

PHONE = {"width": 390, "height": 780}


@pytest.fixture(scope="module")
def library(service: Up, model: SmallModel) -> Iterator[dict[str, str]]:
    """The ids of three models by their names: the still life and two made from it, each smaller than the one before."""
    made = {"still life": model.id}
    for name, opacity in (("a vase", 0.3), ("Berries", 0.6)):
        body = {"min_opacity": opacity, "name": name}
        answer = service.http.post(f"/v1/models/{model.id}/edits", json=body, timeout=120)
        assert answer.status_code == 201, answer.text
        made[name] = answer.json()["model"]
    yield made
    for name, model_id in made.items():
        service.http.patch(f"/v1/models/{model_id}", json={"tags": [], "favourite": False, "name": name})
        if name != "still life":
            service.http.delete(f"/v1/jobs/{model_id}")


def tiles(page: Page, noun: str = "Models") -> Locator:
    return page.get_by_role("list", name=noun, exact=True).locator("> li")


def wait_for_names(page: Page, expected: list[str]) -> None:
    shown = (
        "JSON.stringify([...document.querySelectorAll('#list > li .whole')].map((link) => link.textContent))"
    )
    page.wait_for_function(f"names => {shown} === JSON.stringify(names)", arg=expected)


@pytest.mark.parametrize("noun", ["models", "jobs"])
def test_name_and_tags_are_changed_and_found_by_keyboard(
    service: Up, library: dict[str, str], page: Page, noun: str
) -> None:
    model_id = library["still life"]
    page.goto(f"/{noun}/{model_id}")
    if noun == "jobs":
        expect(page.get_by_role("link", name="Train with other options")).to_be_visible()  # as it has ended
    button = page.get_by_role("button", name="Name and tags")
    button.focus()
    page.keyboard.press("Enter")
    dialog = page.get_by_role("dialog")
    expect(dialog.get_by_label("Name", exact=True)).to_be_focused()
    page.keyboard.press("Tab")
    tags = dialog.get_by_label("Tags")
    expect(tags).to_be_focused()
    page.keyboard.type(", ".join(str(number) for number in range(MOST_TAGS + 1)))
    page.keyboard.press("Enter")
    expect(dialog.get_by_role("alert")).to_contain_text(f"at most {MOST_TAGS}")
    expect(tags).to_be_focused()
    tags.fill(f"Garten, indoors , {noun}")
    page.keyboard.press("Enter")
    expect(dialog).to_be_hidden()
    expect(button).to_be_focused()
    assert not violations(page)
    assert service.http.get(f"/v1/models/{model_id}").json()["tags"] == ["Garten", "indoors", noun]
    page.reload()
    page.get_by_role("list", name="Tags").get_by_role("link", name=noun).press("Enter")
    page.wait_for_url(f"**/{noun}?tag={noun}")
    expect(page.get_by_label("Tag", exact=True)).to_have_value(noun)
    expect(tiles(page, noun.title())).to_have_count(1)


def test_favourites_are_starred_and_filtered(service: Up, library: dict[str, str], page: Page) -> None:
    page.goto("/models")
    star = page.get_by_role("button", name="Favourite: a vase")
    expect(star).to_have_attribute("aria-pressed", "false")
    star.focus()
    page.keyboard.press("Space")
    expect(star).to_have_attribute("aria-pressed", "true")
    expect(star).to_be_focused()
    assert service.http.get(f"/v1/models/{library['a vase']}").json()["favourite"] is True
    page.get_by_label("Favourites").check()
    expect(tiles(page)).to_have_count(1)
    assert page.url.endswith("/models?favourite=true")
    page.reload()
    expect(page.get_by_label("Favourites")).to_be_checked()
    expect(tiles(page)).to_have_count(1)
    page.goto(f"/models/{library['a vase']}")
    page.get_by_role("button", name="Favourite").click()
    expect(page.get_by_role("button", name="Favourite")).to_have_attribute("aria-pressed", "false")
    page.goto("/models?favourite=true")
    expect(page.get_by_role("status")).to_have_text("No models match. Change the filter to see others.")


def test_models_are_sorted(service: Up, library: dict[str, str], page: Page) -> None:
    page.goto("/models")
    wait_for_names(page, ["Berries", "a vase", "still life"])
    first = page.get_by_label("Sort by")
    for order, expected in (
        ("Name", ["a vase", "Berries", "still life"]),
        ("Largest first", ["still life", "a vase", "Berries"]),
    ):
        first.select_option(order)
        wait_for_names(page, expected)
    first.select_option("Highest dB first")
    best = sorted(library, key=lambda name: -service.http.get(f"/v1/models/{library[name]}").json()["psnr"])
    wait_for_names(page, best)
    page.reload()
    expect(first).to_have_value("psnr")
    wait_for_names(page, best)


def test_jobs_are_sorted_as_models_are(service: Up, model: SmallModel, page: Page) -> None:
    ids = cancelled_jobs(service, model.capture, 2)
    try:
        page.goto("/jobs?name=s")
        first = page.get_by_label("Sort by")
        shown = page.locator("#list > li .whole")
        expect(shown.first).to_have_text("series 01")
        first.select_option("Name")
        expect(shown.filter(has_text="series")).to_have_text(["series 00", "series 01"])
        assert page.url.endswith("/jobs?name=s&sort=name")
        for order in ("Largest first", "Highest dB first"):
            first.select_option(order)
            expect(shown.first).to_have_text("still life")  # the others have no model
        page.reload()
        expect(first).to_have_value("psnr")
        expect(shown.first).to_have_text("still life")
    finally:
        for job_id in ids:
            service.http.delete(f"/v1/jobs/{job_id}")


def test_the_tag_field_knows_the_tags(service: Up, library: dict[str, str], page: Page) -> None:
    service.http.patch(f"/v1/models/{library['Berries']}", json={"tags": ["fruit bowl"]})
    page.goto("/models")
    expect(page.locator("#known-tags option[value='fruit bowl']")).to_have_count(1)
    field = page.get_by_label("Tag", exact=True)
    field.press_sequentially("fruit")
    expect(tiles(page)).to_have_count(3)  # a part of a tag is none
    field.press_sequentially(" bowl")
    expect(tiles(page)).to_have_count(1)
    field.fill("no such tag")
    field.press("Enter")
    expect(page.get_by_role("status")).to_contain_text("No models match")


@pytest.mark.parametrize("noun", ["models", "jobs"])
def test_the_lists_with_labels_fit_a_phone(
    service: Up, library: dict[str, str], open_window: Open, noun: str
) -> None:
    tags = ["a tag of thirty characters or", "Blumen", "x" * 40]
    service.http.patch(f"/v1/models/{library['still life']}", json={"tags": tags, "favourite": True})
    page = open_window(service, viewport=PHONE).page
    page.goto(f"/{noun}")
    expect(page.get_by_role("list", name="Tags").first).to_be_visible()
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    assert not violations(page)
    page.get_by_role("link", name="Blumen").click()
    page.wait_for_url(f"**/{noun}?tag=Blumen")
