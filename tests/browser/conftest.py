"""Fixtures of the browser's tests: a real browser, the whole service with the real worker, and pages that are watched.

A page fails its test on an error in the console, a report of the security policy, or a request to another host. Frames
are drawn by the processor (SwiftShader), so tests count them and do not time them.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Browser, BrowserContext, Page, sync_playwright

from tests.support import still_life
from tests.support.up import Up

BROWSERS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
FLAGS = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
"""Graphics in software, as there may be no GPU; no sandbox, as tests may run as root in a container."""

REPORTS = """
globalThis.policyReports = [];
document.addEventListener("securitypolicyviolation", (event) => {
  console.error(`policy: ${event.effectiveDirective} blocked ${event.blockedURI} ${event.sample}`);
});
"""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.slow)


@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    """A browser for the tests of this folder. Its event loop ends with them, because other tests run their own."""
    program = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if program is None:
        pytest.skip(f"no browser is installed: none of {', '.join(BROWSERS)} is on PATH")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Up]:
    """`splatmill up` with the real worker and renderer, without keys."""
    environment = {"SPLATMILL_PIPELINE": "splatmill_worker.pipeline", "OMP_NUM_THREADS": "1"}
    up = Up(tmp_path_factory.mktemp("up") / "data", environment).start()
    yield up
    up.close()


@dataclass
class SmallModel:
    """A finished model of the still life, with cameras and held-out photos.

    id: of the job and of the model.
    capture: id of its capture.
    """

    id: str
    capture: str


@pytest.fixture(scope="session")
def model(service: Up, tmp_path_factory: pytest.TempPathFactory) -> SmallModel:
    """A model of 14 photos with given cameras, trained for some steps on the service."""
    folder = still_life.posed_capture(tmp_path_factory.mktemp("posed") / "capture")
    capture = service.http.post("/v1/captures", json={"name": "still life"}).json()["id"]
    for role in ("images", "poses"):
        for path in sorted((folder / role).iterdir()):
            answer = service.http.put(f"/v1/captures/{capture}/{role}/{path.name}", content=path.read_bytes())
            assert answer.status_code == 201, answer.text
    options = {"steps": 120, "max_gaussians": 3000}
    answer = service.http.post(
        "/v1/jobs", json={"capture": capture, "options": options, "name": "still life"}
    )
    assert answer.status_code == 202, answer.text
    job = service.ended(answer.json()["id"], 120)
    assert job["state"] == "succeeded", job
    return SmallModel(job["id"], capture)


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


Open = Callable[..., Visit]
"""Opens a window on a service: `open_window(up, color_scheme="dark", viewport=...)`."""


@pytest.fixture
def open_window(browser: Browser) -> Iterator[Open]:
    """Open windows whose pages are watched until the test ends."""
    visits: list[Visit] = []
    with ExitStack() as stack:

        def open_on(address: str | Up, **options: Any) -> Visit:
            base = address if isinstance(address, str) else str(address.http.base_url)
            settings: dict[str, Any] = {
                "viewport": {"width": 1280, "height": 800},
                "reduced_motion": "reduce",
            }
            context = browser.new_context(base_url=base, **(settings | options))
            stack.callback(context.close)
            context.add_init_script(REPORTS)
            context.set_default_timeout(20_000)
            watched = Watched(urlsplit(base).netloc)
            context.on("page", watched.watch)
            visits.append(Visit(context.new_page(), context, watched))
            return visits[-1]

        yield open_on
        found = [text for visit in visits for text in visit.watched.unexpected()]
    assert not found


@pytest.fixture
def visit(service: Up, open_window: Open) -> Visit:
    """A window on the service."""
    return open_window(service)


@pytest.fixture
def page(visit: Visit) -> Page:
    """The page of a window on the service."""
    return visit.page
