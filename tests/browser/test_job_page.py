"""The page of a job: a whole small job watched from its beginning to its model, cancelled, and resumed after a lost
connection.

The service, the worker and the browser are real. Not proved here: what a snapshot holds
(tests/worker/pipeline/test_live.py), how the viewer draws it (test_viewer.py), and what watching costs
(`splatmill bench live`).
"""

from __future__ import annotations

import io
import re
import socket
import threading
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Page, Route, expect

from tests.browser.conftest import Open, SmallModel, Visit, requests
from tests.support import still_life
from tests.support.up import Up

NO_WEBGL = """
const before = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
  return kind.startsWith("webgl") ? null : before.call(this, kind, ...more);
};
"""


class Relay:
    """Passes connections on to a service, until they are cut."""

    def __init__(self, port: int) -> None:
        self.port = port
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.open: list[socket.socket] = []
        self.refuses = False
        threading.Thread(target=self._accept, daemon=True).start()

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.listener.getsockname()[1]}"

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                near, _ = self.listener.accept()
                if self.refuses:
                    near.close()
                    continue
                far = socket.create_connection(("127.0.0.1", self.port))
                self.open += [near, far]
                for one, other in ((near, far), (far, near)):
                    threading.Thread(target=self._pass, args=(one, other), daemon=True).start()

    def _pass(self, one: socket.socket, other: socket.socket) -> None:
        with suppress(OSError):
            while data := one.recv(65536):
                other.sendall(data)
        one.close()
        other.close()

    def cut(self) -> None:
        """End all connections, and refuse others until `mend`."""
        self.refuses = True
        for each in self.open:
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
        self.open.clear()

    def mend(self) -> None:
        self.refuses = False


@pytest.fixture
def relay(service: Up) -> Iterator[Relay]:
    port = service.http.base_url.port
    assert port is not None
    relay = Relay(port)
    yield relay
    relay.cut()
    relay.listener.close()


@pytest.fixture(scope="module")
def capture(service: Up, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The still life with its cameras, one photo without a camera, and a mask of no photo."""
    folder = still_life.posed_capture(tmp_path_factory.mktemp("job") / "capture")
    Image.new("RGB", (still_life.WIDTH, still_life.HEIGHT)).save(folder / "images" / "stray.png")
    capture = str(service.http.post("/v1/captures", json={"name": "still life"}).json()["id"])
    for role in ("images", "poses"):
        for path in sorted((folder / role).iterdir()):
            answer = service.http.put(f"/v1/captures/{capture}/{role}/{path.name}", content=path.read_bytes())
            assert answer.status_code == 201, answer.text
    mask = (folder / "images" / "stray.png").read_bytes()
    assert service.http.put(f"/v1/captures/{capture}/masks/nobody.png", content=mask).status_code == 201
    return capture


def submit(service: Up, capture: str, **options: Any) -> str:
    options = {"max_gaussians": 1500, "gaps": "off", "far_shell": "off"} | options
    answer = service.http.post("/v1/jobs", json={"capture": capture, "options": options, "name": "watched"})
    assert answer.status_code == 202, answer.text
    return str(answer.json()["id"])


def snapshots(page: Page, least: int) -> None:
    """Wait until this many snapshots were shown."""
    page.wait_for_function(
        "n => Number(document.querySelector('#live .box[data-snapshots]')?.dataset.snapshots ?? 0) >= n",
        arg=least,
        polling=100,
    )


def live_view(page: Page) -> np.ndarray:
    """What the live view shows, float [H, W, 3]."""
    picture = Image.open(io.BytesIO(page.locator("#live .stage").screenshot(timeout=60_000)))
    return np.asarray(picture.convert("RGB"), np.float64) / 255.0


NOTIFICATIONS = """
globalThis.notified = [];
globalThis.Notification = class {
  static permission = "default";
  static requestPermission = async () => "granted";
  constructor(title, more) { notified.push(`${title}: ${more.body}`); }
};
"""
"""In place of the question of the browser, which nobody is there to answer, and of what the desktop shows."""


def test_the_scene_is_watched_while_it_trains(service: Up, capture: str, open_window: Open) -> None:
    page = open_window(service, viewport={"width": 800, "height": 500}).page
    job_id = submit(service, capture, time_budget="10m")
    page.goto(f"/jobs/{job_id}")
    expect(page.get_by_role("heading", level=1)).to_have_text("watched")
    snapshots(page, 1)
    first = live_view(page)
    assert first.std() > 0.05
    expect(page.locator("#stages")).to_contain_text("left of this stage")
    expect(page.locator("#warnings")).to_contain_text("belongs to no photo by name")
    assert page.evaluate("scrollY + document.querySelector('#warnings').getBoundingClientRect().bottom") < 500
    # Somebody turns the scene: the next snapshots are seen from the same side.
    box = page.locator("#live .box[data-snapshots]")
    before = box.get_attribute("data-pose")
    page.locator("#live .view").first.press("ArrowLeft", delay=200)
    page.wait_for_function(
        "before => document.querySelector('[data-pose]').dataset.pose !== before", arg=before, polling=100
    )
    turned, shown = box.get_attribute("data-pose"), int(box.get_attribute("data-snapshots") or 0)
    snapshots(page, shown + 1)
    assert box.get_attribute("data-pose") == turned
    assert live_view(page).std() > 0.05
    # Loaded anew, the page shows the scene from where it began, and leads back there by a button and by a key.
    page.reload()
    snapshots(page, 1)
    expect(box).to_have_attribute("data-pose", before or "")
    assert live_view(page).std() > 0.05
    view = page.locator("#live .view").first
    for back in (page.get_by_role("button", name="Start view").click, lambda: view.press("Home")):
        view.press("ArrowLeft", delay=200)
        expect(box).not_to_have_attribute("data-pose", before or "")
        back()
        expect(box).to_have_attribute("data-pose", before or "")
    page.get_by_role("button", name="Cancel").click()
    page.get_by_role("button", name="Cancel the job").click()
    expect(page.locator("#state")).to_have_text("Cancelled")


def test_a_whole_job_is_watched_from_its_beginning_to_its_model(
    service: Up, capture: str, open_window: Open
) -> None:
    page = open_window(service, viewport={"width": 800, "height": 500}).page
    job_id = submit(service, capture, time_budget="15s")
    page.add_init_script(NOTIFICATIONS)
    asked = requests(page)
    page.goto(f"/jobs/{job_id}")
    page.get_by_role("button", name="Notify me when it ends").click()
    expect(page.get_by_role("button", name="Notify me when it ends")).to_have_attribute(
        "aria-pressed", "true"
    )
    snapshots(page, 1)

    # It is made before the page of the model asks for it.
    with page.expect_request(f"**/{job_id}/download/sog", timeout=120_000):
        expect(page.locator("#state")).to_have_text("Finished")
    assert page.evaluate("notified") == ["watched: Finished."]
    expect(page.locator("#left")).to_be_empty()
    link = page.get_by_role("link", name="Open the model")
    expect(link).to_have_attribute("href", f"/models/{job_id}")
    job, report = service.job(job_id), service.http.get(f"/v1/jobs/{job_id}/report").json()
    assert report["seconds"]["live"] > 0
    details = page.get_by_role("heading", name=re.compile("What was decided|Seconds by stage|Log"))
    expect(details.locator("visible=true")).to_have_count(0)
    page.get_by_text("Details: what was decided").click()
    expect(details.locator("visible=true")).to_have_count(3)
    expect(page.locator("#facts")).to_contain_text("Time for training alone")
    for sentence in [*job["plan"]["reasons"].values(), *job["plan"]["left_out"].values()]:
        assert page.get_by_text(sentence, exact=True).count() >= 1, sentence
    rows = service.http.get(f"/v1/jobs/{job_id}/curve").json()["rows"]
    expect(page.locator("#curve tbody tr")).to_have_count(len(rows))
    expect(page.locator("#curve polyline")).to_have_count(2)
    expect(page.locator("#curve tbody tr").last).to_contain_text(f"{rows[-1]['psnr']:.2f}")
    photos = page.locator("#photos")
    expect(photos).to_contain_text("2 held out")
    expect(photos.get_by_role("row").filter(has_text="stray.png")).to_contain_text("no camera")
    expect(page.locator("#seconds")).to_contain_text("Live view")
    assert [line.split()[0] for line in asked if line.endswith(f"{job_id}/download/sog")] == ["HEAD"]
    assert {item.get_attribute("data-status") for item in page.locator("#stages > li").all()} == {"done"}

    misfit = next(view["name"] for view in report["views"] if view["split"] == "train")
    report["misfits"] = [{"photo": misfit, "why": "It shows another place."}]
    report["warnings"].append("The masks of 3 photos are not used: none has their shape.")
    page.route(f"**/v1/jobs/{job_id}/report", lambda route: route.fulfill(json=report))
    page.reload()
    expect(page.get_by_role("link", name="Open the model")).to_be_visible()
    expect(photos.get_by_role("row").filter(has_text=misfit)).to_contain_text("It shows another place.")
    expect(page.locator("#warnings")).to_contain_text("The masks of 3 photos are not used")
    expect(page.locator("#log")).to_contain_text("stray.png is left out")
    expect(page.locator("#warnings")).not_to_contain_text("stray.png")
    expect(page.locator("#curve tbody tr")).to_have_count(len(rows))
    page.get_by_role("button", name="Cameras and points").click()
    expect(page.locator("#live .placement")).to_have_attribute("data-cameras", str(still_life.COUNT))
    assert live_view(page).std() > 0.01


def test_a_queued_job_says_its_place_and_a_job_is_cancelled_by_keyboard(
    service: Up, capture: str, relay: Relay, open_window: Open
) -> None:
    running, waiting = (submit(service, capture, time_budget="60s") for _ in range(2))
    visit = open_window(service)
    visit.context.add_init_script(NO_WEBGL)
    page = visit.page
    page.goto(f"/jobs/{waiting}")
    expect(page.locator("#outcome")).to_contain_text("begin")
    page.get_by_role("button", name="Cancel").press("Enter")
    dialog = page.get_by_role("dialog")
    expect(dialog).to_be_visible()
    page.keyboard.press("Escape")
    expect(dialog).to_be_hidden()
    assert not service.job(waiting)["cancel_requested"]

    # Another window loses the connection. When it is back, the job is deleted.
    cut_off = open_window(relay.address)
    cut_off.watched.allow("Failed to load resource")
    cut_off.page.clock.install()
    cut_off.page.goto(f"/jobs/{waiting}")
    expect(cut_off.page.locator("#outcome")).to_contain_text("begin")
    relay.cut()

    # Without WebGL, the newest preview is shown.
    page.goto(f"/jobs/{running}")
    picture = page.get_by_role("img", name="The scene in training")
    expect(picture).to_be_visible(timeout=60_000)
    expect(page.locator("#live .caption")).to_contain_text("WebGL")
    for job_id in (waiting, running):
        page.goto(f"/jobs/{job_id}")
        page.get_by_role("button", name="Cancel").press("Enter")
        page.get_by_role("button", name="Cancel the job").press("Enter")
        expect(page.locator("#state")).to_have_text("Cancelled")
        expect(page.get_by_role("button", name="Restart")).to_be_visible()
        assert service.job(job_id)["state"] == "cancelled"

    service.http.delete(f"/v1/jobs/{waiting}").raise_for_status()
    relay.mend()
    expect(cut_off.page.locator("#outcome")).to_contain_text(waiting)
    expect(cut_off.page.get_by_role("button", name="Cancel")).to_have_count(0)
    asked: list[str] = []
    cut_off.page.on("request", lambda request: asked.append(request.url))
    cut_off.page.clock.run_for(30_000)
    assert asked == [], "the page asks no more for what is deleted"


def test_a_failed_job_says_why_and_what_to_do(service: Up, visit: Visit) -> None:
    page = visit.page
    capture = service.http.post("/v1/captures", json={"name": "empty photos"}).json()["id"]
    for name, colour in (("a.png", "gray"), ("b.png", "silver"), ("c.png", "white")):
        body = io.BytesIO()
        Image.new("RGB", (64, 48), colour).save(body, "PNG")
        service.http.put(f"/v1/captures/{capture}/images/{name}", content=body.getvalue())
    options = {"preset": "draft", "time_budget": "90s", "gaps": "off", "test_views": ["a.png"]}
    asked = {"capture": capture, "options": options}
    job_id = service.http.post("/v1/jobs", json=asked).json()["id"]
    page.goto(f"/jobs/{job_id}")
    expect(page.locator("#state")).to_have_text("Failed")
    expect(page.get_by_role("heading", name="Log", exact=True)).to_be_visible()
    for name in ("Live view", "Quality against time"):
        expect(page.get_by_role("heading", name=name)).to_be_hidden()
    problem = service.job(job_id)["problem"]
    alert = page.get_by_role("alert")
    expect(alert).to_contain_text(problem["detail"])
    expect(alert).to_contain_text(problem["advice"])

    service.http.put(f"/v1/bin/captures/{capture}").raise_for_status()
    page.get_by_role("link", name="Train with other options").click()
    page.wait_for_url(f"**/?capture={capture}&options_of={job_id}")
    page.locator("html[data-ready]").wait_for()
    expect(page.locator("#place")).to_contain_text(
        "These photos are in the bin. A job on them takes them out"
    )
    page.get_by_role("button", name="Train", exact=True).click()
    page.wait_for_url("**/jobs/*")
    repeated = service.job(page.url.rpartition("/")[2])
    assert repeated["id"] != job_id
    assert repeated["options"] == service.job(job_id)["options"]


def test_a_lost_connection_is_shown_and_the_page_goes_on_where_it_was(
    service: Up, capture: str, relay: Relay, open_window: Open
) -> None:
    visit = open_window(relay.address)
    visit.watched.allow("ERR_EMPTY_RESPONSE|ERR_CONNECTION|ERR_INCOMPLETE|Failed to load resource")
    page = visit.page
    asked: list[str | None] = []
    page.on(
        "request",
        lambda request: (
            asked.append(request.headers.get("last-event-id")) if request.url.endswith("/events") else None
        ),
    )
    job_id = submit(service, capture, time_budget="6s")
    page.goto(f"/jobs/{job_id}")
    expect(page.locator("#stages [data-status=now]")).to_contain_text("Training")
    relay.cut()
    expect(page.locator("#lost")).to_be_visible()
    service.ended(job_id)
    relay.mend()
    expect(page.locator("#state")).to_have_text("Finished")
    expect(page.locator("#lost")).to_have_count(0)
    rows = service.http.get(f"/v1/jobs/{job_id}/curve").json()["rows"]
    expect(page.locator("#curve tbody tr")).to_have_count(len(rows))
    assert asked[0] is None


def test_an_answer_that_breaks_off_is_told_as_a_lost_connection(page: Page) -> None:
    page.goto("/jobs")
    told = page.evaluate("""async () => {
      const { whole } = await import(new URL("../api.js", document.querySelector("script[type=module]").src));
      const cut = () => new Response(new ReadableStream({ start: (it) => it.error(new TypeError("network error")) }));
      const kinds = [cut().json(), cut().arrayBuffer(), new Response("{").json()];
      return Promise.all(kinds.map((body) => whole(body).catch((error) => error.code ?? error.name)));
    }""")
    assert told == ["unreachable", "unreachable", "SyntaxError"]


def test_a_scene_that_comes_before_its_cameras_is_seen_from_where_they_are(
    page: Page, model: SmallModel
) -> None:
    page.goto(f"/jobs/{model.id}")
    poses = page.evaluate(
        """async (id) => {
          const { LiveScene } = await import("/page/any/job/live_scene.js");
          const placement = await (await fetch(`/v1/jobs/${id}/cameras`)).json();
          const snapshot = await (await fetch(`/v1/models/${id}/files/model.ply`)).arrayBuffer();
          const scene = (steps) => steps.reduce(async (before, step) => {
            const made = await before;
            if (step === "cameras") made.setPlacement(placement, new Map());
            else await made.draw(snapshot.slice());
            return made;
          }, Promise.resolve(new LiveScene(document.body.appendChild(document.createElement("div")), id)));
          const [late, early] = [await scene(["draw", "cameras"]), await scene(["cameras", "draw"])];
          const pose = () => late.boxes.scene.dataset.pose;
          const [framed, target] = [pose(), early.boxes.scene.dataset.pose];
          const far = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -99], [0, 0, 0, 1]];
          late.view.setCamera({ ...late.view.getCamera(), camera_to_world: far });
          const away = pose();
          late.homeButton.click();
          return [framed, pose(), target, away];
        }""",
        model.id,
    )
    framed, home, target, away = poses
    assert framed == home == target != away


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_page_fits_a_phone(service: Up, model: SmallModel, open_window: Open, scheme: str) -> None:
    page = open_window(service, viewport={"width": 360, "height": 740}, color_scheme=scheme).page
    # Until the server has answered, nothing is shown that may be false.
    held: list[Route] = []
    for late in ("events", "report"):
        page.route(f"**/v1/jobs/{model.id}/{late}", lambda route: held.append(route))
        with page.expect_request(f"**/{late}"):
            held.pop().continue_() if held else page.goto(f"/jobs/{model.id}")
        expect(page.get_by_role("heading", level=1)).to_have_text("still life")
        page.evaluate("new Promise((drawn) => requestAnimationFrame(() => requestAnimationFrame(drawn)))")
        shown = page.locator("main").inner_text()
        assert not re.search("in a moment|Waiting|Nothing was measured|Nothing can be seen", shown), shown
    held.pop().continue_()
    expect(page.get_by_role("link", name="Open the model")).to_be_visible()
    page.locator("#curve summary").click()
    expect(page.locator("#curve svg")).to_be_visible()
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    assert page.evaluate("document.querySelector('#curve svg').getBoundingClientRect().width") <= 340


def test_a_job_that_is_not_there_says_so(page: Page, visit: Any) -> None:
    visit.watched.allow("404")
    page.goto("/jobs/0123456789abcdef")
    expect(page.get_by_role("alert")).to_contain_text("The list of jobs shows those that are there.")


COURSE = """async (records) => {
  const { Course } = await import('/page/any/job/course.js');
  const course = new Course();
  for (const [seconds, event, attempt = 1] of records) {
    course.apply({ event, attempt, at: new Date(1e12 + 1000 * seconds).toISOString() });
  }
  const { state, plan, lines, rows, stages } = course;
  return {
    state, plan, lines: lines.length, steps: rows.map((row) => row.step),
    eta: stages.get('matching')?.eta ?? null, seconds: Object.fromEntries(course.seconds(1e12 + 200_000)),
  };
}"""


def test_the_course_of_a_job_follows_from_its_events(page: Page) -> None:
    state = lambda name: {"type": "state", "state": name}  # noqa: E731
    metric = lambda step: {"type": "metric", "step": step, "seconds": step / 10, "gaussians": 5}  # noqa: E731
    matching = lambda done: {"type": "progress", "stage": "matching", "done": done, "total": 100}  # noqa: E731
    begun: list[list[Any]] = [
        [0, state("queued"), 0],
        [10, state("preparing")],
        [12, state("sfm")],
        [20, matching(10)],
        [30, matching(20)],
    ]
    page.goto("/jobs")
    now = page.evaluate(COURSE, begun)
    assert now["state"] == "sfm"
    assert now["eta"] == pytest.approx(40.0), "ten seconds for a fifth"
    assert now["seconds"] == {"queued": 10, "preparing": 2, "sfm": 188}

    trained: list[list[Any]] = [
        *begun,
        [50, state("training")],
        [51, {"type": "plan", "plan": {"densify": True}}],
        *([52 + step / 10, metric(step)] for step in (10, 20, 30)),
        [60, {"type": "log", "message": "x"}],
    ]
    # The worker was killed: the next attempt continues from a checkpoint at step 15, and measures again what follows.
    resumed = [*trained, [70, state("queued")], [80, state("training"), 2], [81, metric(20), 2]]
    again = page.evaluate(COURSE, resumed)
    assert again["steps"] == [10, 20]
    assert again["plan"] == {"densify": True}
    assert again["seconds"]["queued"] == 20
    # A restart is another run: what it measures may go on with what was measured.
    restarted = page.evaluate(COURSE, [*trained, [70, state("failed")], [100, state("queued"), 0]])
    assert (restarted["state"], restarted["plan"], restarted["lines"]) == ("queued", None, 1)
    assert restarted["seconds"] == {"queued": 100}
    assert restarted["steps"] == [10, 20, 30]


SECONDS_LEFT = """async ([at, spent, eta, stage, estimate]) => {
    const { Course } = await import("/page/any/job/course.js");
    const { secondsLeft } = await import("/page/any/job/left.js");
    const course = new Course(), time = (seconds) => new Date(1e12 + 1000 * seconds).toISOString();
    let now = 0;
    for (const [state, seconds] of spent) {
        course.apply({ event: { type: "state", state }, at: time(now), attempt: 1 });
        now += seconds;
    }
    const event = { type: "progress", stage, done: 5, total: 10, eta };
    if (stage) course.apply({ event, at: time(now), attempt: 1 });
    return secondsLeft(course, new Map(Object.entries(estimate)), 1e12 + 1000 * (now + at));
}"""


def test_a_number_of_steps_that_is_a_bound_is_called_one(page: Page) -> None:
    said = """async ([at_most, note]) => {
        const { Course } = await import("/page/any/job/course.js");
        const { showTimeline } = await import("/page/any/job/timeline.js");
        const course = new Course(), list = document.createElement("ol"), at = new Date(1e12).toISOString();
        const progress = { type: "progress", stage: "training", done: 1200, total: 4000, eta: 20, at_most, note };
        for (const event of [{ type: "state", state: "training" }, progress]) course.apply({ event, at, attempt: 1 });
        showTimeline(list, course, 1e12);
        return list.querySelector(".stage-now p").textContent;
    }"""
    page.goto("/glossary")
    whole = page.evaluate(said, [None, "tile 1 of 4"])
    assert (whole.count("about"), whole.count("at most"), "tile 1 of 4" in whole) == (2, 0, True)
    bound = page.evaluate(said, [True, None])
    assert (bound.count("about"), bound.count("at most")) == (0, 2)


def test_the_units_of_a_scene_in_tiles_are_counted_by_kind(page: Page) -> None:
    rows = """async (events) => {
        const { Course } = await import("/page/any/job/course.js");
        const { unitParts } = await import("/page/any/job/units.js");
        const course = new Course(), at = new Date(1e12).toISOString();
        for (const event of events) course.apply({ event: { type: "unit", tiles: 9, ...event }, at, attempt: 1 });
        const lines = [...unitParts(course.units).querySelectorAll("tbody tr")];
        return lines.map((line) => [...line.children].map((cell) => cell.textContent));
    }"""
    page.goto("/glossary")
    done = [
        ("photos", 1, None),
        ("cameras", 4, None),
        ("coarse", 8, 500),
        ("tile-1", 2, 1000),
        ("tile-7", 4, 2000),
    ]
    events: list[dict[str, Any]] = [{"unit": "tile-1", "state": "running"}]
    events += [{"unit": unit, "state": "done", "seconds": s, "gaussians": n} for unit, s, n in done]
    events += [{"unit": "tile-2", "state": "running"}, {"unit": "tile-9", "state": "failed"}]
    events += [{"unit": f"tile-{number}", "state": "elsewhere"} for number in (3, 4)]
    assert page.evaluate(rows, events) == [
        ["Photos", "✓", "", "", "1.0 s"],
        ["Cameras", "✓", "", "", "4.0 s"],
        ["Coarse model", "✓", "", "500", "8.0 s"],
        ["Tiles", "2 of 9", "2; 3, 4 on other workers; 9 failed", "3,000", "3.0 s"],
        ["Last steps of tiles", "0 of 9", "", "", ""],
        ["Whole scene", "", "", "", ""],
    ]
    # With its attempt, what was in work has ended.
    state = lambda name: {"type": "state", "state": name}  # noqa: E731
    lost = page.evaluate(rows, [state("training"), *events, state("queued")])
    assert lost[3] == ["Tiles", "2 of 9", "9 failed", "3,000", "3.0 s"]
    many = [{"unit": f"seam-{number}", "state": "elsewhere"} for number in range(1, 8)]
    assert page.evaluate(rows, [*many, {"unit": "scene", "state": "running"}])[4:] == [
        ["Last steps of tiles", "0 of 9", "7 on other workers", "", ""],
        ["Whole scene", "", "yes", "", ""],
    ]
    divided = [{"unit": f"features-{number}", "state": "done", "seconds": number} for number in (1, 3)]
    divided += [{"unit": "features-2", "state": "elsewhere"}, {"unit": "pairs", "state": "running"}]
    assert page.evaluate(rows, divided)[:4] == [
        ["Photos", "", "", "", ""],
        ["Features of photos", "2", "2 on other workers", "", "2.0 s"],
        ["Pairs of photos", "", "yes", "", ""],
        ["Cameras", "", "", "", ""],
    ]
    mapped = [{"unit": "mapping-1", "state": "running"}, {"unit": "mapping-2", "state": "elsewhere"}]
    assert page.evaluate(rows, mapped)[1] == ["Parts of the mapping", "0", "1; 2 on other workers", "", ""]


@pytest.mark.parametrize(
    ("at", "spent", "eta", "stage", "left"),
    [
        (0, [["queued", 5]], None, None, 130),
        (0, [["queued", 5], ["preparing", 4]], None, None, 126),
        (0, [["queued", 5], ["preparing", 4], ["sfm", 10]], None, None, 116),
        (
            0,
            [["queued", 5], ["preparing", 4], ["sfm", 50]],
            None,
            None,
            106,
        ),  # longer than others: over at any moment
        (0, [["queued", 5], ["preparing", 4], ["sfm", 50], ["training", 10]], 70, "training", 76),
        (5, [["queued", 5], ["preparing", 4], ["sfm", 50], ["training", 10]], 70, "training", 71),
        # The scene is finished, and compared with its photos: nothing of the training is left.
        (2, [["queued", 5], ["preparing", 4], ["sfm", 50], ["training", 10]], 7, "evaluation", 11),
        (2, [["queued", 5], ["preparing", 4], ["sfm", 50], ["training", 10]], None, "evaluation", 6),
        (
            0,
            [["queued", 5], ["preparing", 4], ["sfm", 50], ["training", 10], ["exporting", 2]],
            None,
            None,
            4,
        ),
    ],
)
def test_the_time_left_counts_all_that_is_to_come(
    visit: Visit, at: float, spent: Any, eta: float | None, stage: str | None, left: float
) -> None:
    estimate = {"cameras": 20, "training": 100, "rest": 10}
    visit.page.goto("/glossary")
    assert visit.page.evaluate(SECONDS_LEFT, [at, spent, eta, stage, estimate]) == left
    assert visit.page.evaluate(SECONDS_LEFT, [at, spent, eta, stage, estimate | {"rest": None}]) is None
