"""What the page that takes photos says of them together, before anything is sent: photos that share nothing, that all
show one view, and that are all blurred; and that there is no warning of real captures.

Not proved here: that structure from motion succeeds where there is no warning. There was none of the other captures of
../shared/data either, at 52 photos each; they would take minutes here.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image, ImageFilter
from playwright.sync_api import Locator, Page, expect

from tests.browser.new.test_new import give, opened
from tests.support.paths import DATA

CAPTURES = ("kermit_640x480/images", "failure_pure_rotation/images")
SIDE = 480
"""Pixels of the longer side at which photos are given, so that they are examined soon; thumbnails are smaller."""


def small(folder: Path, names: list[Path], blur: float = 0.0) -> list[Path]:
    """Copies of photos, as small as is enough."""
    copies = []
    for number, name in enumerate(names):
        with Image.open(name) as picture:
            picture.thumbnail((SIDE, SIDE))
            kept = picture if picture.mode == "RGBA" else picture.convert("RGB")
            shown = kept.filter(ImageFilter.GaussianBlur(blur)) if blur else kept
            copies.append(folder / f"{number:03d}_{name.stem}.png")
            shown.save(copies[-1], compress_level=1)
    return copies


def photos_of(capture: str) -> list[Path]:
    if not (DATA / capture).is_dir():
        pytest.skip(f"needs the photos of {DATA / capture}")
    return sorted(path for path in (DATA / capture).iterdir() if path.suffix.lower() in (".jpg", ".png"))


def warnings(page: Page, photos: list[Path]) -> Locator:
    """Give photos, wait until they are compared, and return the warnings."""
    give(opened(page), *photos)
    expect(page.locator("#remarks")).to_have_attribute("data-compared", "true", timeout=120_000)
    return page.locator("#remarks .error")


@pytest.mark.parametrize("capture", CAPTURES)
def test_real_captures_get_no_warning(page: Page, tmp_path: Path, capture: str) -> None:
    photos = photos_of(capture)
    said = warnings(page, small(tmp_path, photos))
    expect(said).to_have_count(0)


def test_photos_with_nothing_in_common_are_said_to_be(page: Page, tmp_path: Path) -> None:
    said = warnings(page, small(tmp_path, photos_of("failure_unrelated_640/images")))
    expect(said).to_contain_text(
        "These photos seem to have nothing in common: 9 of the 9 that were compared share no details"
    )
    expect(page.get_by_role("button", name="Upload and train")).to_be_enabled()


def test_two_places_and_a_stray_photo_are_named(page: Page, tmp_path: Path) -> None:
    fox, toy = photos_of("fox_540x960/images")[:6], photos_of("kermit_640x480/images")[:5]
    stray = photos_of("failure_unrelated_640/images")[0]
    said = warnings(page, small(tmp_path, [*fox, *toy, stray]))
    expect(said.first).to_contain_text("2 places that have nothing in common: 6 photos and 5 photos")
    expect(said.last).to_contain_text(
        f"1 photo seems to share no details with the others: 011_{stray.stem}.png"
    )
    # What is left out is compared no more.
    for name in [f"Leave out {number:03d}_" for number in range(6, 12)]:
        page.get_by_role("button", name=name).click()
    expect(page.locator("#remarks .error")).to_have_count(0)


def test_one_view_and_blurred_photos_are_said_to_be(page: Page, tmp_path: Path) -> None:
    names = photos_of("kermit_640x480/images")
    with Image.open(names[0]) as picture:
        for number in range(6):
            picture.save(tmp_path / f"{number}.jpg", quality=60 + 6 * number)
    expect(warnings(page, sorted(tmp_path.glob("?.jpg")))).to_contain_text("show nearly the same view")
    page.reload()
    expect(warnings(page, small(tmp_path, names[:6], blur=3))).to_contain_text("all look blurred")
