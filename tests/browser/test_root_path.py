"""The web page below a path of its host, where a proxy has put the server: one that strips the path and says nothing of
it, and one that keeps it and names it in a header. Photos are sent, a model is shown and shared, and a key signs in.

What each page shows in detail is tested in the files of the pages.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from PIL import Image
from playwright.sync_api import Page, expect

from splatmill_server.base.root_path import HEADER
from tests.browser.conftest import Open, SmallModel
from tests.support import still_life
from tests.support.servers.path_proxy import path_proxy
from tests.support.up import Up

LONG = 60_000
"""Milliseconds for what takes a moment, on a machine that runs other tests beside it."""

PROXIES: dict[str, dict[str, Any]] = {
    "stripped": {"strip": True, "host": False},
    "kept": {"strip": False, "sent": {HEADER: "/splats"}},
}


@pytest.fixture(params=PROXIES)
def address(request: pytest.FixtureRequest, service: Up) -> Iterator[str]:
    """Where the browser finds the service, without a slash at the end."""
    with path_proxy(urlsplit(str(service.http.base_url)).port or 0, **PROXIES[request.param]) as published:
        yield published


def outside(page: Page, address: str) -> list[str]:
    """A list that grows by the addresses outside of the service's for which the page asks."""
    addresses: list[str] = []
    inside = (f"{address}/", "blob:", "data:")
    page.on("request", lambda asked: None if asked.url.startswith(inside) else addresses.append(asked.url))
    return addresses


def test_photos_are_sent_and_the_job_is_followed(
    service: Up, address: str, open_window: Open, tmp_path: Path
) -> None:
    for number, (_, rgb, _) in enumerate(still_life.pictures()[:3]):
        Image.fromarray(rgb).save(tmp_path / f"still_{number:02d}.jpg", quality=95)
    # Larger than a piece, so that it goes to the address in Location.
    Image.effect_noise((3400, 3400), 100).save(tmp_path / "large.png")
    page = open_window(address).page
    strays = outside(page, address)
    page.goto(f"{address}/")
    page.locator("html[data-ready]").wait_for(timeout=LONG)
    page.set_input_files("#folder", tmp_path)
    expect(page.locator("#summary")).to_contain_text("4 photos", timeout=LONG)
    page.get_by_role("button", name="Upload and train").click()
    page.wait_for_url(re.compile(f"^{re.escape(address)}/jobs/[0-9a-f]+$"), timeout=LONG)
    job = page.url.rsplit("/", 1)[-1]
    try:
        capture = service.http.get(f"/v1/captures/{service.job(job)['capture']}").json()
        sizes = {file["name"]: file["size"] for file in capture["files"]}
        assert sizes == {path.name: path.stat().st_size for path in tmp_path.iterdir()}
        service.http.post(f"/v1/jobs/{job}/cancel")
        expect(page.locator("#state")).to_have_text("Cancelled", timeout=LONG)  # by the stream of events
        page.get_by_role("link", name="Jobs").click()
        expect(page).to_have_url(f"{address}/jobs")
        expect(page.get_by_role("link", name="Jobs")).to_have_attribute("aria-current", "page")
    finally:
        service.http.post(f"/v1/jobs/{job}/cancel")
        service.ended(job)
        service.http.delete(f"/v1/jobs/{job}")
    assert strays == []


def test_a_model_is_shown_and_shared(address: str, model: SmallModel, open_window: Open) -> None:
    page = open_window(address).page
    strays = outside(page, address)
    page.goto(f"{address}/models")
    page.get_by_role("link", name="still life").first.click()
    expect(page).to_have_url(f"{address}/models/{model.id}")
    expect(page.locator("#viewer[data-ready]")).to_be_visible(timeout=LONG)
    expect(page.locator("#compare figcaption")).to_contain_text(re.compile(r"PSNR \d\d\.\d dB"), timeout=LONG)
    with page.expect_download(timeout=LONG) as download:
        page.locator("#downloads").get_by_role("link", name="model.ply").click()
    assert download.value.path().read_bytes().startswith(b"ply")
    page.get_by_role("button", name="Share").click()
    page.get_by_role("button", name="Make a link").click()
    link = page.get_by_role("dialog").get_by_label("The link")
    expect(link).to_have_value(re.compile(f"^{re.escape(address)}/s/"))

    private = open_window(address).page  # another context: no cookies, nothing stored
    strays += outside(private, address)
    for ending in ("", "/embed"):
        private.goto(link.input_value() + ending)
        expect(private.get_by_role("heading", level=1)).to_have_text("still life")
        expect(private.locator("#view .view")).to_be_visible(timeout=LONG)
    expect(private.get_by_role("link", name="Open the page")).to_have_attribute(
        "href", urlsplit(link.input_value()).path
    )
    assert strays == []
