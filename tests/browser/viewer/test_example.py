"""The example scene is offered where a server has nothing yet, and is trained when somebody asks for it.

Not proved here: the photos that a worker makes (tests/worker/pipeline/test_example.py), and the training, for which a
stand-in runs here.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import expect

from splatmill.schema import EXAMPLE_FILE
from tests.browser.conftest import Open
from tests.support.up import Up


@pytest.fixture(scope="module")
def empty(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Up]:
    """A service without any records, whose worker does not train."""
    up = Up(tmp_path_factory.mktemp("empty") / "data").start()
    yield up
    up.close()


@pytest.mark.parametrize("path", ["/models", "/jobs", "/"])
def test_the_example_is_trained_where_it_is_asked_for(empty: Up, open_window: Open, path: str) -> None:
    for capture in empty.http.get("/v1/captures").json()["captures"]:
        for job in empty.http.get("/v1/jobs", params={"capture": capture["id"]}).json()["jobs"]:
            empty.ended(job["id"])
            empty.http.delete(f"/v1/jobs/{job['id']}").raise_for_status()
        empty.http.delete(f"/v1/captures/{capture['id']}").raise_for_status()
    page = open_window(empty).page
    page.goto(path)
    page.get_by_role("button", name="Train the example scene").click()
    page.wait_for_url("**/jobs/*")
    expect(page.get_by_role("heading", level=1)).to_have_text("Still life")
    (job,) = empty.http.get("/v1/jobs").json()["jobs"]
    assert page.url.endswith(job["id"])
    files = empty.http.get(f"/v1/captures/{job['capture']}").json()["files"]
    assert [(file["role"], file["name"]) for file in files] == [("images", EXAMPLE_FILE)]

    # Another job on the same photos has settings of its own, and is not refused for a lack of photos.
    page.goto(f"/?capture={job['capture']}")
    page.locator("html[data-ready]").wait_for()
    expect(page.get_by_role("button", name="Train the example scene")).to_have_count(0)
    page.get_by_role("button", name="Train", exact=True).click()
    page.wait_for_url("**/jobs/*")
    assert len(empty.http.get("/v1/jobs").json()["jobs"]) == 2


def test_why_the_example_is_not_trained_is_said_beside_the_button(
    empty: Up, open_window: Open, tmp_path: Path
) -> None:
    visit = open_window(empty)
    visit.watched.allow("503")
    visit.page.route("**/v1/captures", lambda route: route.fulfill(status=503, json=FULL))
    visit.page.goto("/models?name=")
    visit.page.get_by_role("button", name="Train the example scene").click()
    expect(visit.page.locator(".example [role=alert]")).to_contain_text("The storage is away.")
    expect(visit.page.get_by_role("button", name="Train the example scene")).to_be_enabled()


FULL = {"code": "storage_unavailable", "status": 503, "title": "No storage", "detail": "The storage is away."}
