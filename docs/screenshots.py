"""Makes the documentation's pictures of the web page: a real job on photos of the built-in still life, in both themes.

    make screenshots

It needs a browser (Debian: chromium-headless-shell) and some minutes. The pictures are `docs/web/NAME-THEME.webp`.
"""

import io
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import httpx
from PIL import Image
from playwright.sync_api import Error, Page, sync_playwright

from tests.browser.conftest import FLAGS
from tests.support.programs import program
from tests.support.up import Up

OUT = Path(__file__).parent / "web"
WINDOW = {"width": 1200, "height": 800}
WIDTH = 960
"""Pixels of a picture's width."""

CHECKED = "() => /photos/.test(summary.textContent) && !/checked/.test(summary.textContent)"
"""Whether the page has looked at all photos."""

DRAWN = """() => {
  const view = document.querySelector(".view");
  return view?.dataset.frames > 0 && !view.querySelector("img") && !view.querySelector(".said").textContent;
}"""
"""Whether the view shows the model, and neither its picture nor that it is being loaded."""

PHOTOS = 30
OPTIONS = {"time_budget": "60s"}


def main() -> int:
    """Run the service, a job on it, and a browser over its pages."""
    OUT.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        photos = Path(folder) / "photos"
        still_life = [sys.executable, "-m", "splatmill_worker.synthetic", str(photos), "--count", str(PHOTOS)]
        subprocess.run(still_life, check=True)
        up = Up(Path(folder) / "data", {"SPLATMILL_PIPELINE": "splatmill_worker.pipeline"})
        try:
            base = str(up.start().http.base_url)
            with sync_playwright() as playwright:
                browser = playwright.chromium.launch(
                    executable_path=program("chromium-headless-shell"), args=FLAGS
                )
                pages = {
                    theme: browser.new_context(base_url=base, color_scheme=theme, viewport=WINDOW).new_page()  # type: ignore[arg-type]  # both are themes
                    for theme in ("light", "dark")
                }
                for page in pages.values():
                    page.set_default_timeout(180_000)  # the job trains beside the browser
                walk(pages, up, sorted(photos.glob("*.jpg")) or sorted(photos.glob("*.png")))
                browser.close()
        finally:
            up.close()
    return 0


def walk(pages: dict[str, Page], up: Up, photos: list[Path]) -> None:
    """Take the pictures: photos given, a job while it trains, the lists, the model, and a link to it."""
    for theme, page in pages.items():
        page.goto("/")
        page.locator("input[type=file]").first.set_input_files(photos)
        page.locator("#photos li").nth(len(photos) - 1).wait_for(timeout=120_000)
        page.wait_for_function(CHECKED, timeout=300_000, polling=500)
        take(page, f"new-{theme}")
    job = start(up.http, photos)
    for theme, page in pages.items():  # one after the other: each draws in software while the job trains
        page.goto(f"/jobs/{job}")
        page.get_by_text("The scene after").wait_for(timeout=600_000)
        page.wait_for_timeout(4000)
        take(page, f"job-{theme}")
        page.goto("about:blank")
    record = up.ended(job, 900)
    if record["state"] != "succeeded":
        raise SystemExit(f"The job ended as {record['state']}: {record.get('problem')}")
    link = up.http.post(f"/v1/models/{job}/shares", json={"expires_in": "1h"}).json()["path"]
    for theme, page in pages.items():
        for name, address in (
            ("report", f"/jobs/{job}"),
            ("jobs", "/jobs"),
            ("models", "/models"),
            ("model", f"/models/{job}"),
            ("share", link),
        ):
            page.goto(address)
            if name in ("model", "share"):
                page.wait_for_function(DRAWN, timeout=300_000, polling=500)
            elif name == "report":
                page.get_by_text("The model is finished.").wait_for()
            page.wait_for_timeout(1500)
            take(page, f"{name}-{theme}")


def start(http: httpx.Client, photos: list[Path]) -> str:
    """Send the photos and start a job on them; returns its id."""
    capture = http.post("/v1/captures", json={"name": "Still life"}).json()["id"]
    for photo in photos:
        http.put(f"/v1/captures/{capture}/images/{photo.name}", content=photo.read_bytes()).raise_for_status()
    body: dict[str, Any] = {"capture": capture, "name": "Still life", "options": OPTIONS}
    return str(http.post("/v1/jobs", json=body).json()["id"])


def take(page: Page, name: str) -> None:
    """Write a picture of the window as it is."""
    with Image.open(io.BytesIO(_shot(page))) as shot:  # our own browser's, not a stranger's
        small = shot.convert("RGB").resize(
            (WIDTH, round(shot.height * WIDTH / shot.width)), Image.Resampling.LANCZOS
        )
        small.save(OUT / f"{name}.webp", quality=72, method=6)
    print(name, flush=True)


def _shot(page: Page, tries: int = 3) -> bytes:
    """A PNG of the window. A browser that draws 3D in software may be too busy for one at first."""
    try:
        return page.screenshot(timeout=120_000)
    except Error:
        if tries == 1:
            raise
        page.wait_for_timeout(5000)
        return _shot(page, tries - 1)


if __name__ == "__main__":
    sys.exit(main())
