"""The page at `/` on a phone and for one: photos that are taken one by one, and the code that leads a phone there.

Not proved here: a phone's own camera dialogue.
"""

from __future__ import annotations

import io
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, expect

from tests.browser.conftest import Open
from tests.browser.new.test_new import opened
from tests.support.page.qr_code import read_code
from tests.support.up import Up


def test_a_phone_takes_photos_one_by_one(
    service: Up, open_window: Open, photos: Path, tmp_path: Path
) -> None:
    phone = open_window(service, viewport={"width": 360, "height": 740}, has_touch=True, is_mobile=True)
    page = opened(phone.page)
    expect(page.get_by_role("button", name="Take a photo")).to_be_visible()
    expect(page.locator("#shot")).to_have_attribute("capture", "environment")
    for number, path in enumerate(sorted(photos.iterdir())[:2]):
        (tmp_path / str(number)).mkdir()
        shot = tmp_path / str(number) / "image.jpg"  # phones call each photo so
        shot.write_bytes(path.read_bytes())
        page.set_input_files("#shot", shot)
    expect(page.locator(".photo .name")).to_have_text(["image-2.jpg", "image.jpg"])
    page.get_by_text("All settings").click()
    expect(page.locator("#phone")).to_be_hidden()
    assert page.evaluate("document.documentElement.scrollWidth") <= 360


def test_the_code_for_phones_can_be_read(page: Page, tmp_path: Path) -> None:
    opened(page)
    page.get_by_text("Take the photos with a phone").click()
    expect(page.locator("#phone-help")).to_contain_text("an address that only this machine reaches")
    address = "http://192.168.0.20:8080/?capture=9f2b6c1d04e8a735"
    script = """async (address) => {
      const { phoneHelp } = await import("/page/any/new/phone.js");
      const { isLoopback } = await import("/page/any/address.js");
      document.getElementById("main").prepend(await phoneHelp(new URL(address), false, true));
      return ["localhost", "127.0.0.1", "[::1]", "192.168.0.20", "example.org"].map(isLoopback);
    }"""
    assert page.evaluate(script, address) == [True, True, True, False, False]
    picture = Image.open(io.BytesIO(page.locator("svg.qr").screenshot())).convert("RGBA")
    assert read_code(picture, tmp_path) == address


def test_without_the_packages_a_phone_is_told_the_address(page: Page) -> None:
    opened(page)
    # As the server marks its pages then; modules under another digest are evaluated anew.
    script = """async (address) => {
      document.documentElement.dataset.viewer = "missing";
      const { phoneHelp } = await import("/page/anew/new/phone.js");
      document.getElementById("phone-help").replaceChildren(await phoneHelp(new URL(address), false, true));
    }"""
    page.get_by_text("Take the photos with a phone").click()
    expect(page.locator("#phone-help")).to_contain_text("an address that only this machine reaches")
    page.route("**/vendor/**", lambda route: route.abort())
    page.evaluate(script, "http://192.168.0.20:8080/")
    expect(page.locator("#phone-help")).to_contain_text("Open http://192.168.0.20:8080/ on the phone.")
    expect(page.locator("#phone-help")).to_contain_text("make install")
    expect(page.locator("#phone-help .qr")).to_have_count(0)
