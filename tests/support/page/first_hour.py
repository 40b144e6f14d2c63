"""Walks the first hour of a new user in a browser, at three sizes and in two themes, and keeps a picture of each step.

    make walk                     # pictures in demo/walk/STEP/SIZE-THEME.png

A real service trains a small job on photos that the page sends. The pictures are for people; the walk itself fails
where a step cannot be done, and prints what a page wrote to its console as an error.
"""

import re
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, expect, sync_playwright

from splatmill_worker.synthetic import orbit, photograph, still_life
from tests.browser.conftest import FLAGS, REAL
from tests.support.programs import program
from tests.support.up import Up

SIZES = {"desktop": (1440, 900), "laptop": (1024, 768), "phone": (390, 780)}
THEMES = ("light", "dark")
LONG = 300_000
"""Milliseconds for a job, and for pictures that are drawn in software beside it."""

DRAWN = """() => {
  const view = document.querySelector(".view");
  return view?.dataset.frames > 0 && !view.querySelector("img") && !view.querySelector(".said").textContent;
}"""
"""Whether the view shows the model, and neither its picture nor that it is being loaded."""


class Walk:
    """One walk: a window of one size and theme, and where its pictures go."""

    def __init__(self, page: Page, out: Path, label: str) -> None:
        self.page, self.out, self.label = page, out, label
        page.set_default_timeout(LONG)
        expect.set_options(timeout=LONG)

    def see(self, step: str, *, whole: bool = True) -> None:
        """Keep a picture of the page, or of the window alone."""
        target = self.out / step / f"{self.label}.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        self.page.wait_for_timeout(400)
        self.page.screenshot(path=target, full_page=whole, timeout=LONG)
        wide = self.page.evaluate("document.documentElement.scrollWidth - innerWidth")
        print(f"{step} {self.label}{f': {wide} pixels too wide' if wide > 0 else ''}", flush=True)

    def give(self, photos: Path) -> None:
        """Give the photos to the page, and see what it says of them."""
        self.page.goto("/")
        self.page.locator("html[data-ready]").wait_for()
        self.see("01-new")
        self.page.set_input_files("#folder", photos)
        expect(self.page.locator("#remarks")).to_have_attribute("data-compared", "true", timeout=LONG)
        self.see("02-photos")
        self.page.get_by_text("All settings").click()
        self.see("03-settings")

    def train(self) -> str:
        """Send the photos, watch the job until it has ended, and return its id."""
        self.page.locator("#option-time_budget").fill("20s")
        self.page.get_by_role("button", name="Upload and train").click()
        self.page.wait_for_url(re.compile("/jobs/"))
        expect(self.page.locator("#live .box[data-snapshots]")).to_have_count(1, timeout=LONG)
        self.see("04-job-runs")
        expect(self.page.locator("#state")).to_have_text("Finished", timeout=LONG)
        return self.page.url.rsplit("/", 1)[1]

    def show(self, address: str) -> None:
        """Open a page with a view, and wait until it has drawn."""
        self.page.goto(address)
        self.page.wait_for_function(DRAWN, polling=500)

    def use(self, model: str, other: str, link: str) -> None:
        """Everything that people do with a model that is finished."""
        page = self.page
        page.goto(f"/jobs/{model}")
        expect(page.locator("#curve polyline")).not_to_have_count(0)
        self.see("05-job-ended")
        page.get_by_role("button", name="Name and tags").click()
        self.see("06-name-and-tags", whole=False)
        self.show(f"/models/{model}")
        self.see("07-model")
        for number, tool in enumerate(
            ("Measure", "Annotate", "Crop and clean", "Camera path", "For visitors")
        ):
            button = page.get_by_role("button", name=tool, exact=True)
            button.click()
            if tool == "Crop and clean":
                page.get_by_role("button", name="Lasso").click()
                box = page.locator(".view").bounding_box()
                assert box is not None
                for index, (x, y) in enumerate(
                    ((0.35, 0.3), (0.6, 0.3), (0.6, 0.75), (0.35, 0.75), (0.35, 0.3))
                ):
                    page.mouse.move(box["x"] + x * box["width"], box["y"] + y * box["height"], steps=5)
                    if index == 0:
                        page.mouse.down()
                page.mouse.up()
            page.wait_for_timeout(1500)
            self.see(f"08-tool-{number}-{tool.split()[0].lower()}", whole=False)
            button.click()
        page.get_by_role("button", name="Share").click()
        self.see("09-share-dialog", whole=False)
        page.keyboard.press("Escape")
        for step, address in (("10-link", link), ("11-embed", f"{link}/embed")):
            self.show(address)
            self.see(step)
        for step, address, ready in (
            ("12-models", "/models", "#storage table"),
            ("13-jobs", "/jobs", "#list li"),
            ("14-compare", f"/compare?left={model}&right={other}", ".view"),
            ("15-open", "/open", "h1"),
            ("16-glossary", "/glossary", "h1"),
            ("17-nothing-there", "/nothing/there", "h1"),
            ("18-sign-in", "/sign-in", "h1"),
        ):
            page.goto(address)
            page.locator(ready).first.wait_for()
            page.wait_for_timeout(3000 if ready == ".view" else 500)
            self.see(step)


@contextmanager
def walks(up: Up, out: Path) -> Iterator[list[Walk]]:
    """Open a window of each size and theme."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program("chromium-headless-shell"), args=FLAGS)
        opened = []
        for size, (width, height) in SIZES.items():
            for theme in THEMES:
                context = browser.new_context(
                    base_url=str(up.http.base_url),
                    color_scheme="dark" if theme == "dark" else "light",
                    viewport={"width": width, "height": height},
                    has_touch=size == "phone",
                    reduced_motion="reduce",
                )
                page = context.new_page()
                page.on("console", lambda said: print(said.text) if said.type == "error" else None)
                opened.append(Walk(page, out, f"{size}-{theme}"))
        yield opened
        browser.close()


def main(out: Path) -> int:
    """Walk at every size and in every theme; the first walk sends the photos."""
    with tempfile.TemporaryDirectory() as folder:
        photos = Path(folder) / "still life"
        photos.mkdir()
        scene = still_life(0)
        for number, camera in enumerate(orbit(16, 480, 360)):
            rgb, _ = photograph(scene, camera, samples=1)
            Image.fromarray(rgb).save(photos / f"still_{number:02d}.jpg", quality=95)
        up = Up(Path(folder) / "data", REAL).start()
        try:
            with walks(up, out) as all_walks:
                for walk in all_walks:
                    walk.give(photos)
                model = all_walks[0].train()
                labels = {"tags": ["still life", "indoors"], "favourite": True}
                up.http.patch(f"/v1/models/{model}", json=labels).raise_for_status()
                edit = {"min_opacity": 0.3, "name": "Still life, cleaned"}
                other = up.http.post(f"/v1/models/{model}/edits", json=edit, timeout=300).json()["model"]
                link = up.http.post(f"/v1/models/{model}/shares", json={"expires_in": "1h"}).json()["path"]
                up.http.get(f"/v1/models/{model}/download/sog", timeout=300).raise_for_status()
                for walk in all_walks:
                    walk.use(model, other, link)
                    walk.page.close()  # each draws in software
        finally:
            up.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1] if len(sys.argv) > 1 else "demo/walk")))
