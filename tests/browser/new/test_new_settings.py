"""Settings that a job would be refused for are refused in the form of the page at `/`, beside each field, before any
file is sent: every pair that excludes each other, and a time that is too short for the photos.

Does not prove that these are all such pairs (tests/worker/splat/plan/test_conflicts.py).
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from splatmill.schema.conflicts import CONFLICTS, Conflict
from tests.browser.conftest import SmallModel, Visit
from tests.browser.new.test_new import CHECKED, give, opened

EXCLUDED = {
    ("pose_refinement", "backend"): ("on", "gpu"),
    ("cluster_culling", "backend"): ("on", "gpu"),
    ("far_shell", "start"): ("on", "model.spz"),
    ("gaps", "start"): ("on", "model.spz"),
    ("tiles", "time_budget"): ("4", "60s"),
    ("tiles", "within"): ("4", "10m"),
    ("tiles", "start"): ("4", "scan.las"),
    ("tiles", "progress_video"): ("4", "view"),
    ("tiles", "time_lapse"): ("4", "on"),
}
"""Values that exclude each other, by their options."""


def titled(name: str) -> str:
    """The title of a setting."""
    return "Time for training alone" if name == "time_budget" else name.replace("_", " ").capitalize()


def put(page: Page, name: str, value: str) -> None:
    field = page.locator(f"#option-{name}")
    if field.evaluate("(field) => field instanceof HTMLSelectElement"):
        field.select_option(value)
    else:
        field.fill(value)


def sent(page: Page) -> list[str]:
    """The addresses below /v1/ of the requests that change something, as they come."""
    addresses: list[str] = []
    page.on(
        "request",
        lambda request: addresses.append(request.url) if request.method in ("POST", "PUT") else None,
    )
    return addresses


@pytest.mark.parametrize("conflict", CONFLICTS, ids=lambda conflict: "-".join(conflict.names))
def test_settings_that_exclude_each_other_are_refused_where_they_are(
    visit: Visit, photos: Path, conflict: Conflict
) -> None:
    visit.watched.allow("status of 422")
    page = opened(visit.page)
    give(page, *sorted(photos.iterdir())[:3])
    addresses = sent(page)
    page.get_by_text("All settings").click()
    values = dict(zip(conflict.names, EXCLUDED[conflict.names], strict=True))
    for name, value in values.items():
        expect(page.locator(f"#option-{name}-error")).to_be_empty()
        put(page, name, value)
    # Names that are no words are shown as the titles of the settings.
    said = re.sub(r"\b[a-z]+_[a-z]+\b", lambda name: f'"{titled(name[0])}"', conflict.reason)
    for name in conflict.names:
        expect(page.locator(f"#option-{name}-error")).to_have_text(said)
        expect(page.locator(f"#option-{name}")).to_have_attribute("aria-invalid", "true")
    page.get_by_role("button", name="Upload and train").click()
    expect(page.locator("#problem")).to_contain_text(said)
    expect(page.locator("#doing")).to_be_empty()
    assert {address.rsplit("/v1/")[1] for address in addresses} == {"estimate"}
    put(page, conflict.names[0], "")
    for name in conflict.names:
        expect(page.locator(f"#option-{name}-error")).to_be_empty()


def test_a_time_that_is_too_short_is_refused_where_it_is(
    visit: Visit, photos: Path, model: SmallModel
) -> None:
    """The server is asked as if there were many more photos, with cameras as those of the job that it knows: the least
    time of all is too short for them.
    """
    visit.watched.allow("status of 422")
    page = opened(visit.page)

    def many(route: Any) -> None:
        asked = json.loads(route.request.post_data)
        assert (asked["photos"], asked["exact"], asked["capture"]) == (14, True, None)
        route.continue_(post_data=json.dumps(asked | {"photos": 50_000, "posed": True}))

    page.route("**/v1/estimate", many)
    give(page, photos)
    addresses = sent(page)
    page.get_by_label("Time for everything").fill("5s")
    error = page.locator("#option-within-error")
    expect(error).to_contain_text("for the cameras of 50000 photos", timeout=CHECKED)
    expect(error).to_contain_text("s or more, or fewer photos.")
    page.get_by_role("button", name="Upload and train").click()
    expect(page.locator("#problem")).to_contain_text("Time for everything: The fastest of the jobs")
    expect(page.get_by_label("Time for everything")).to_be_focused()
    assert {address.rsplit("/v1/")[1] for address in addresses} == {"estimate"}


def test_the_first_settings_are_in_sight_once_there_are_photos(visit: Visit, photos: Path) -> None:
    page = opened(visit.page)  # 1280 by 800 pixels
    give(page, photos)
    page.get_by_text("How this was derived").wait_for()
    preset = page.locator(".segments").first.bounding_box()
    bar = page.locator("#go").bounding_box()
    assert preset is not None
    assert bar is not None
    assert page.evaluate("scrollY") == 0
    assert preset["y"] + preset["height"] < bar["y"], "the button's bar does not cover them"
    assert bar["y"] + bar["height"] == 800, "nothing is seen below the bar"
