"""Fixtures of the browser's tests: a real browser, the whole service with the real worker, and pages that are watched.

A page fails its test on an error in the console, a report of the security policy, or a request to another host. Frames
are drawn by the processor (SwiftShader), so tests count them and do not time them.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from PIL import Image
from playwright.sync_api import Browser, BrowserContext, Page, expect, sync_playwright

from tests.support import still_life
from tests.support.made_once import made_once
from tests.support.programs import program
from tests.support.up import Up

FLAGS = [
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-compositing",
    "--no-sandbox",
]
"""Graphics in software, as there may be no GPU: WebGL by SwiftShader, and pages without it, which takes a fifth less of
the processor. No sandbox, as tests may run as root in a container."""

PATIENCE = 60_000
"""Milliseconds that a page has for what it is asked, where a test says nothing else. What is quick ends no later."""

REPORTS = """
globalThis.policyReports = [];
document.addEventListener("securitypolicyviolation", (event) => {
  console.error(`policy: ${event.effectiveDirective} blocked ${event.blockedURI} ${event.sample}`);
});
"""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    here = f"{Path(__file__).parent}{os.sep}"
    for item in items:
        if str(item.path).startswith(here):
            item.add_marker(pytest.mark.slow)


@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    """A browser for the tests of this folder. Its event loop ends with them, because other tests run their own."""
    executable = program("chromium-headless-shell")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=executable, args=FLAGS)
        yield browser
        browser.close()


REAL = {"SPLATMILL_PIPELINE": "splatmill_worker.pipeline", "OMP_NUM_THREADS": "1"}
"""The environment of a service with the real worker."""


@dataclass
class SmallModel:
    """A finished model of the still life, with cameras and held-out photos.

    id: of the job and of the model.
    capture: id of its capture.
    """

    id: str
    capture: str


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a service leaves that has trained the small model: its data folder `data`, and the ids in `model.json`.

    It is trained once for all test processes.
    """
    return made_once(tmp_path_factory, "trained", _train)


def _train(folder: Path) -> None:
    """Train a model of 14 photos with given cameras for some steps on a service."""
    photos = still_life.posed_capture(folder / "capture")
    up = Up(folder / "data", REAL).start()
    try:
        capture = up.http.post("/v1/captures", json={"name": "still life"}).json()["id"]
        for role in ("images", "poses"):
            for path in sorted((photos / role).iterdir()):
                answer = up.http.put(f"/v1/captures/{capture}/{role}/{path.name}", content=path.read_bytes())
                assert answer.status_code == 201, answer.text
        options = {"steps": 120, "max_gaussians": 3000}
        answer = up.http.post("/v1/jobs", json={"capture": capture, "options": options, "name": "still life"})
        assert answer.status_code == 202, answer.text
        job = up.ended(answer.json()["id"], 120)
        assert job["state"] == "succeeded", job
    finally:
        up.close()
    (folder / "model.json").write_text(json.dumps({"id": job["id"], "capture": capture}))


@pytest.fixture(scope="session")
def lasting_service(trained: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Up]:
    """`splatmill up` with the real worker and renderer, without keys, on a copy of what `trained` holds."""
    data = tmp_path_factory.mktemp("up") / "data"
    shutil.copytree(trained / "data", data, ignore=shutil.ignore_patterns("*.sock"))
    up = Up(data, REAL).start()
    yield up
    up.close()


@pytest.fixture(scope="module")
def service(lasting_service: Up) -> Iterator[Up]:
    """The service of this test process. What a file of tests makes is deleted after it: lists begin alike for all."""
    before = {kind: _ids(lasting_service, kind) for kind in ("jobs", "captures")}
    yield lasting_service
    for kind, ids in before.items():
        for made in _ids(lasting_service, kind) - ids:
            if kind == "jobs":
                lasting_service.http.post(f"/v1/jobs/{made}/cancel")  # 409 if it has ended
                lasting_service.ended(made, 60)
            assert lasting_service.http.delete(f"/v1/{kind}/{made}").status_code == 204


def _ids(up: Up, kind: str) -> set[str]:
    """The ids of all jobs or captures, of which there are fewer than a page holds."""
    return {record["id"] for record in up.http.get(f"/v1/{kind}").json()[kind]}


@pytest.fixture(scope="session")
def model(lasting_service: Up, trained: Path) -> SmallModel:
    """The model that the service holds."""
    return SmallModel(**json.loads((trained / "model.json").read_text()))


@pytest.fixture(scope="session")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of 14 photos of the still life."""
    folder = tmp_path_factory.mktemp("photos")
    for number, (_, rgb, _) in enumerate(still_life.pictures()):
        picture = Image.fromarray(rgb).resize((4 * still_life.WIDTH, 4 * still_life.HEIGHT))
        picture.save(folder / f"still_{number:02d}.jpg", quality=95)
    return folder


@dataclass
class Watched:
    """What went wrong on the pages of a context.

    complaints: console errors, uncaught errors, and requests to other hosts.
    """

    host: str
    complaints: list[str] = field(default_factory=list)
    _allowed: list[re.Pattern[str]] = field(default_factory=list)

    def allow(self, pattern: str) -> None:
        """Expect complaints that match, such as a status that a test provokes."""
        self._allowed.append(re.compile(pattern))

    def unexpected(self) -> list[str]:
        """Return the complaints that no test has allowed."""
        return [text for text in self.complaints if not any(known.search(text) for known in self._allowed)]

    def watch(self, page: Page) -> None:
        """Note what goes wrong on a page."""
        page.on("console", lambda message: self._console(message.type, message.text, message.location))
        page.on("pageerror", lambda error: self.complaints.append(f"uncaught: {error}"))
        page.on("request", lambda request: self._request(request.url))

    def _console(self, kind: str, text: str, location: Any) -> None:
        if kind == "error" or text.startswith(
            "Error with"
        ):  # what is wrong with a header is a warning to browsers
            self.complaints.append(f"console: {text} {location.get('url', '')}")

    def _request(self, url: str) -> None:
        parts = urlsplit(url)
        if parts.scheme not in ("blob", "data") and parts.netloc != self.host:
            self.complaints.append(f"request to another host: {url}")


@dataclass
class Visit:
    """A browser's window on a service: `page` to drive, `watched` to allow what a test provokes."""

    page: Page
    context: BrowserContext
    watched: Watched


def requests(page: Page) -> list[str]:
    """Methods and addresses of what a page asks for, one line each, filled as it does."""
    asked: list[str] = []
    page.on("request", lambda request: asked.append(f"{request.method} {request.url}"))
    return asked


Open = Callable[..., Visit]
"""Opens a window on a service: `open_window(up, color_scheme="dark", viewport=...)`."""


@pytest.fixture
def pixels_per_unit() -> float:
    """Pixels of the screen per pixel of CSS, along an axis: pages are laid out as ever, and drawing takes a quarter.

    Files that compare what is drawn with other pictures have a fixture of their own.
    """
    return 0.5


@pytest.fixture
def open_window(browser: Browser, pixels_per_unit: float) -> Iterator[Open]:
    """Open windows whose pages are watched until the test ends."""
    visits: list[Visit] = []
    with ExitStack() as stack:

        def open_on(address: str | Up, **options: Any) -> Visit:
            base = address if isinstance(address, str) else str(address.http.base_url)
            settings: dict[str, Any] = {
                "viewport": {"width": 1280, "height": 800},
                "device_scale_factor": pixels_per_unit,
                "reduced_motion": "reduce",
            }
            context = browser.new_context(base_url=base, **(settings | options))
            stack.callback(context.close)
            context.add_init_script(REPORTS)
            context.set_default_timeout(PATIENCE)
            expect.set_options(timeout=PATIENCE)
            watched = Watched(urlsplit(base).netloc)
            context.on("page", watched.watch)
            visits.append(Visit(context.new_page(), context, watched))
            return visits[-1]

        yield open_on
        complaints = [text for visit in visits for text in visit.watched.unexpected()]
    assert not complaints


@pytest.fixture
def visit(service: Up, open_window: Open) -> Visit:
    """A window on the service."""
    return open_window(service)


@pytest.fixture
def page(visit: Visit) -> Page:
    """The page of a window on the service."""
    return visit.page
