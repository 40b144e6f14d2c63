"""The whole way of a person who opens the page: photos are given, the job is watched, the model is compared with a
photo that it has not seen, and downloaded, and a link opens it in a private window.

Everything is real: the photos are of the still life, cameras are recovered from them. What each page shows in detail is
tested in the files of the pages.
"""

from __future__ import annotations

import re
import zipfile
from pathlib import Path

from PIL import Image
from playwright.sync_api import expect

from splatmill_worker.synthetic import orbit, photograph, still_life
from tests.browser.conftest import Open
from tests.support.up import Up

LONG = 120_000
"""Milliseconds for a job of a few seconds, on a machine that runs other tests beside it."""


def test_from_photos_to_a_shared_link(service: Up, open_window: Open, tmp_path: Path) -> None:
    photos = tmp_path / "still life"
    photos.mkdir()
    scene = still_life(0)
    for number, camera in enumerate(orbit(16, 240, 180)):
        rgb, _ = photograph(scene, camera, samples=1)
        Image.fromarray(rgb).save(photos / f"still_{number:02d}.jpg", quality=95)

    page = open_window(service).page
    page.goto("/")
    page.locator("html[data-ready]").wait_for()
    page.set_input_files("#folder", photos)
    expect(page.locator("#summary")).to_contain_text("16 photos")
    page.locator("#name").fill("journey")
    page.locator("#option-time_budget").fill("5s")
    page.get_by_role("button", name="Upload and train").click()

    page.wait_for_url(re.compile("/jobs/"), timeout=LONG)
    expect(page.get_by_role("heading", level=1)).to_have_text("journey")
    expect(page.locator("#live .box[data-snapshots]")).to_have_count(1, timeout=LONG)
    expect(page.locator("#state")).to_have_text("Finished", timeout=LONG)
    expect(page.locator("#curve polyline")).not_to_have_count(0)
    page.get_by_role("link", name="Open the model").click()

    expect(page.locator("#viewer[data-ready]")).to_be_visible(timeout=LONG)
    expect(page.locator("#compare figcaption")).to_contain_text(re.compile(r"PSNR \d\d\.\d dB"), timeout=LONG)
    with page.expect_download(timeout=LONG) as download:
        page.locator("#downloads").get_by_role("link", name=re.compile(r"sog", re.IGNORECASE)).first.click()
    download.value.save_as(tmp_path / "model.sog")
    with zipfile.ZipFile(tmp_path / "model.sog") as archive:
        assert "meta.json" in archive.namelist()

    page.get_by_role("button", name="Share").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("For whom").fill("for mum")
    page.keyboard.press("Enter")
    link = dialog.get_by_label("The link")
    expect(link).to_have_value(re.compile("/s/"))

    private = open_window(service).page  # another context: no cookies, nothing stored
    private.goto(link.input_value())
    expect(private.get_by_role("heading", level=1)).to_have_text("journey")
    private.wait_for_function(
        "() => Number(document.querySelector('#view .view')?.dataset.frames) > 0", timeout=LONG, polling=100
    )
