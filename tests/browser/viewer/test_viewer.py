"""The viewer in a real browser: what it draws of each format against the server's renderer, what it refuses, that
another model keeps the camera, that nothing is drawn while nothing moves, keyboard, mouse and touch, and the view
without WebGL.

Does not prove how fast it is: frames are drawn by the processor here.
"""

from __future__ import annotations

import base64
import io
import math
import re
import zipfile
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image
from playwright.sync_api import Page, Route, expect

from tests.browser.conftest import Open, SmallModel, Visit
from tests.browser.model.test_edit import picture
from tests.browser.model.test_model_page import show
from tests.support.files import splat_transform
from tests.support.up import Up

FLOOR = 34.0
"""PSNR in dB of the canvas against the server's picture. PlayCanvas blends in 8 bits, packs colours, and cuts off
Gaussians that are larger than the view, of which a model of so few steps has many."""

SAME = 45.0
"""PSNR in dB from which two pictures of the canvas are the same: Gaussians of about one depth are sorted anew with each
file, and may change places (47.6 dB once, on a busy machine)."""

MOUNT = """async ([model, options]) => {
  const { open } = await import("/page/any/viewer.js");
  const sheet = document.createElement("link");
  sheet.rel = "stylesheet";
  sheet.href = "/page/any/viewer.css";
  document.head.append(sheet);
  await new Promise((done) => sheet.addEventListener("load", done));
  const box = document.createElement("div");
  box.id = "box";
  document.body.append(box);
  Object.assign(box.style, { position: "fixed", zIndex: 99, top: 0, left: 0, width: "480px", height: "360px" });
  const { cameras } = await (await fetch(`${model}/cameras`)).json();
  globalThis.cameras = cameras;
  globalThis.troubles = [];
  const url = `${model}/files/model.ply`;
  globalThis.view = await open(box, { model, url, cameras: cameras.map((c) => c.camera), ...options });
  view.addEventListener("trouble", (event) => troubles.push(event.detail));
  return view.kind;
}"""

RESTED = """() => {
  const cameras = [...(view.surface?.app?.renderer.gsplatDirector.camerasMap.values() ?? [])];
  const sorters = cameras.flatMap((each) => [...each.layersMap.values()]).map((each) => each.gsplatManager?.cpuSorter);
  const busy = view.pending || sorters.some((sorter) => sorter?.jobsInFlight > 0);
  globalThis.looks = !busy && view.frames > 0 && view.frames === globalThis.before ? globalThis.looks + 1 : 0;
  globalThis.before = view.frames;
  return globalThis.looks >= 2;
}"""


def mount(page: Page, model: SmallModel, **options: Any) -> str:
    """Open the viewer on an empty page of the server; returns the kind of the view."""
    page.goto("/models")
    kind = page.evaluate(MOUNT, [f"/v1/models/{model.id}", options])
    rest(page)
    return str(kind)


def rest(page: Page) -> None:
    """Wait until nothing is being sorted or waits to be drawn, and no frame was drawn between three looks.

    PlayCanvas sorts beside the page, and on a busy machine the order of the Gaussians comes seconds after the frame.
    """
    page.evaluate("globalThis.before = -1; globalThis.looks = 0")
    page.wait_for_function(RESTED, polling=200)


def pixels(page: Page) -> npt.NDArray[np.float64]:
    """The view as it is shown, RGB [H, W, 3] in 0 to 1."""
    with Image.open(io.BytesIO(page.locator("#box").screenshot())) as shown:
        return np.asarray(shown.convert("RGB")) / 255.0


def camera(page: Page) -> dict[str, Any]:
    spec: dict[str, Any] = page.evaluate("view.getCamera()")
    return spec


def rendered(http: httpx.Client, model: SmallModel, view: dict[str, Any]) -> npt.NDArray[np.float64]:
    answer = http.post(f"/v1/models/{model.id}/render", json={"camera": view})
    assert answer.status_code == 200, answer.text
    with Image.open(io.BytesIO(answer.content)) as picture:
        return np.asarray(picture.convert("RGB")) / 255.0


def psnr(a: npt.NDArray[np.float64], b: npt.NDArray[np.float64]) -> float:
    return -10 * math.log10(max(float(((a - b) ** 2).mean()), 1e-10))


@pytest.fixture
def pixels_per_unit() -> float:
    """Pixel for pixel what the server renders."""
    return 1.0


@pytest.fixture
def shown(visit: Visit, model: SmallModel) -> Page:
    assert mount(visit.page, model) == "webgl"
    return visit.page


def test_the_canvas_shows_what_the_renderer_renders(service: Up, model: SmallModel, shown: Page) -> None:
    looks = [camera(shown)]
    for index in (0, 5, 8):
        shown.evaluate(
            """(i) => { const c = cameras[i].camera;
               view.setCamera({ ...c, fov_y_deg: 360 / Math.PI * Math.atan(c.height / 2 / c.fy) }); }""",
            index,
        )
        rest(shown)
        looks.append(camera(shown))
        agreement = psnr(pixels(shown), rendered(service.http, model, looks[-1]))
        assert agreement > FLOOR
    assert len({str(look["camera_to_world"]) for look in looks}) == 4
    off = camera(shown)
    off["fov_y_deg"] += 1
    assert psnr(pixels(shown), rendered(service.http, model, off)) < agreement - 5, "it detects one degree"


def test_the_start_is_upright_and_looks_at_the_middle(shown: Page) -> None:
    matrix = np.array(camera(shown)["camera_to_world"])
    photos = shown.evaluate("cameras.map((c) => c.camera.camera_to_world)")
    up = -np.mean([np.array(photo)[:3, 1] for photo in photos], axis=0)
    assert abs(matrix[:3, 0] @ up) < 1e-6 * np.linalg.norm(up)
    assert matrix[:3, 1] @ up < 0
    assert any(np.allclose(matrix[:3, 3], np.array(photo)[:3, 3]) for photo in photos)
    focus = np.array(shown.evaluate("view.focus"))
    ahead = (focus - matrix[:3, 3]) / np.linalg.norm(focus - matrix[:3, 3])
    assert np.allclose(matrix[:3, 2], ahead, atol=1e-6)


def test_another_model_keeps_the_camera_and_the_old_one_until_then(shown: Page, model: SmallModel) -> None:
    shown.keyboard.press("Tab")
    shown.locator(".view").focus()
    shown.keyboard.press("ArrowLeft")
    rest(shown)
    before, picture = camera(shown), pixels(shown)
    for _ in range(2):
        shown.evaluate(
            """async (address) => {
              const bytes = new Uint8Array(await (await fetch(address)).arrayBuffer());
              await view.replace({ bytes });
            }""",
            f"/v1/models/{model.id}/files/model.ply",
        )
        rest(shown)
    assert camera(shown) == before
    assert psnr(pixels(shown), picture) > SAME
    error = shown.evaluate(
        "view.replace({ bytes: new TextEncoder().encode('no model') }).catch((e) => [e.reason, e.message])"
    )
    assert error[0] == "format"
    assert "it begins with the bytes 6e 6f 20 6d" in error[1]
    rest(shown)
    assert psnr(pixels(shown), picture) > SAME, "a file that cannot be read leaves the view as it was"


REPLACE = """([text]) => view.replace({ bytes: Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)) })
  .then(() => null, (error) => [error.name, error.reason ?? "", error.message])"""


def replaced(page: Page, content: bytes) -> list[str] | None:
    """Show the model of a file's bytes; returns the error's class, reason and message, or None."""
    said: list[str] | None = page.evaluate(REPLACE, [base64.b64encode(content).decode()])
    return said


def test_every_format_is_drawn_from_addresses_and_from_bytes(
    service: Up, model: SmallModel, shown: Page, tmp_path: Path
) -> None:
    reference = rendered(service.http, model, camera(shown))
    count = shown.evaluate("view.gaussians")
    assert psnr(pixels(shown), reference) > FLOOR
    for format, way in (("compressed.ply", "address"), ("sog", "address"), ("sog", "bytes")):
        address = f"/v1/models/{model.id}/download/{format}"
        # Between two models nothing is drawn that could pass for the second one.
        shown.evaluate("view.surface.splats.enabled = false; view.again()")
        rest(shown)
        assert psnr(pixels(shown), reference) < 20
        if way == "bytes":
            assert replaced(shown, service.http.get(address).content) is None
        else:
            shown.evaluate("(url) => view.replace({ url })", address)
        rest(shown)
        assert psnr(pixels(shown), reference) > FLOOR, (format, way)
        assert 0.9 * count < shown.evaluate("view.gaussians") <= count, format
    source, foreign = tmp_path / "model.ply", tmp_path / "foreign.sog"
    source.write_bytes(service.http.get(f"/v1/models/{model.id}/files/model.ply").content)
    splat_transform.convert(source, foreign, "-g", "cpu")
    assert replaced(shown, foreign.read_bytes()) is None
    rest(shown)
    assert psnr(pixels(shown), reference) > FLOOR


def changed(archive: bytes, **members: bytes | None) -> bytes:
    """A `.sog` with other bytes for some of its images, or without them."""
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(archive)) as before, zipfile.ZipFile(stream, "w") as after:
        for name in before.namelist():
            content = members.get(name.partition(".")[0], before.read(name))
            if content is not None:
                after.writestr(name, content)
    return stream.getvalue()


def test_files_that_draw_nothing_are_refused(service: Up, model: SmallModel, visit: Visit) -> None:
    visit.watched.allow("404")  # PlayCanvas looks beside the page for an image that a .sog lacks
    page = visit.page
    mount(page, model)
    before = pixels(page)
    sog, spz = (
        service.http.get(f"/v1/models/{model.id}/download/{name}", timeout=60).content
        for name in ("sog", "spz")
    )
    ply = service.http.get(f"/v1/models/{model.id}/files/model.ply").content
    header = b"ply\nformat binary_little_endian 1.0\nelement vertex %d\n"
    place = b"property float x\nproperty float y\nproperty float z\nend_header\n"
    for content, reason, said in (
        (b"", "empty", "is empty"),
        (spz, "format", "of the format .spz"),
        (b"\0\1\2\3 and more", "format", "begins with the bytes 00 01 02 03"),
        (header % 0 + place, "empty", "no Gaussians"),
        (header % 2 + place + bytes(24), "unreadable", "without Gaussians"),
        (ply.replace(b" opacity\n", b" unknown\n"), "unreadable", "without Gaussians"),
        (ply[: len(ply) // 2], "unreadable", "could not be read"),
        (sog[: len(sog) // 2], "unreadable", "zip"),
        (changed(sog, means_l=b"no image"), "unreadable", "means_l.webp"),
        (changed(sog, sh0=None), "unreadable", "sh0"),
        (changed(sog, shN_labels=None), "unreadable", "shN_labels"),
        (changed(sog, meta=b"{}"), "unreadable", "could not be read"),
    ):
        answer = replaced(page, content)
        assert answer is not None, said
        assert answer[1] == reason, answer
        assert said in answer[2], answer
    rest(page)
    assert psnr(pixels(page), before) > SAME, "the model before stays"


def test_what_lies_beyond_a_radius_is_not_drawn(service: Up, model: SmallModel, shown: Page) -> None:
    whole = pixels(shown)
    middle, spread = shown.evaluate("[view.middle, view.spread]")
    content = service.http.get(f"/v1/models/{model.id}/files/model.ply").content
    head, _, rows = content.partition(b"end_header\n")
    vertices = np.frombuffer(rows, np.float32).reshape(-1, head.count(b"property float"))
    distances = np.linalg.norm(vertices[:, :3] - middle, axis=1) / spread
    radius = float(np.median(distances))
    shown.evaluate("(radius) => view.hideBeyond(radius)", radius)
    rest(shown)
    hidden = pixels(shown)
    assert psnr(hidden, whole) < 25
    inside = vertices[distances <= radius]
    head = head.replace(b"vertex %d\n" % len(vertices), b"vertex %d\n" % len(inside))
    shown.evaluate("view.hideBeyond(null)")
    assert replaced(shown, head + b"end_header\n" + inside.tobytes()) is None
    rest(shown)
    assert psnr(pixels(shown), hidden) > 45, "it is the model without what lies outside"


def test_the_far_background_is_hidden_and_shown_by_the_control_of_the_page(
    service: Up, model: SmallModel, page: Page
) -> None:
    """The page is answered a report of a far shell, which so small a model is trained without."""
    cameras = service.http.get(f"/v1/models/{model.id}/cameras").json()["cameras"]
    places = np.array([each["camera"]["camera_to_world"] for each in cameras])[:, :3, 3]
    file = f"/v1/models/{model.id}/files/model.ply"
    head, _, rows = service.http.get(file).content.partition(b"end_header\n")
    means = np.frombuffer(rows, np.float32).reshape(-1, head.count(b"property float"))[:, :3]
    middle = places.mean(axis=0)
    spread = np.linalg.norm(places - middle, axis=1).max()
    report = service.http.get(f"/v1/models/{model.id}/files/report.json").json()
    report["plan"]["far_shell"] = True
    # The control leaves what lies within 0.4 of this distance: about half of the Gaussians.
    report["facts"]["shell_distance"] = float(
        np.median(np.linalg.norm(means - middle, axis=1)) / spread / 0.4
    )
    page.route("**/files/report.json", lambda route: route.fulfill(json=report))
    show(page, model)
    whole = picture(page)
    control = page.get_by_role("button", name="Hide far background")
    control.click()
    expect(control).to_have_attribute("aria-pressed", "true")
    assert psnr(picture(page), whole) < 25
    control.click()
    assert psnr(picture(page), whole) > 45


def test_nothing_is_drawn_while_nothing_moves(shown: Page) -> None:
    drawn = shown.evaluate("view.frames")
    shown.evaluate("new Promise((done) => setTimeout(done, 600))")
    assert shown.evaluate("view.frames") == drawn
    assert drawn < 12


def test_keys_mouse_and_touch_move_the_camera(shown: Page) -> None:
    view = shown.locator(".view")
    view.focus()
    start = camera(shown)
    for key in ("ArrowLeft", "ArrowUp", "+", "w", "d", "e"):
        before = camera(shown)
        shown.keyboard.press(key)
        rest(shown)
        assert camera(shown) != before, key
    shown.keyboard.press("Home")
    assert camera(shown) == start
    box = view.bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    distance = "view.distance"
    was = shown.evaluate(distance)
    shown.mouse.move(x, y)
    shown.mouse.wheel(0, 200)
    shown.wait_for_function(f"() => {distance} > {was}", polling=100)
    shown.mouse.down()
    shown.mouse.move(x + 60, y + 10, steps=3)
    shown.mouse.up()
    turned = camera(shown)
    assert turned["camera_to_world"][0][0] != start["camera_to_world"][0][0]
    # Two fingers, twice as far apart: nearer.
    was = shown.evaluate(distance)
    shown.evaluate(
        """([x, y]) => {
          const at = (type, id, dx) => view.element.dispatchEvent(new PointerEvent(type,
            { pointerId: id, pointerType: "touch", clientX: x + dx, clientY: y, bubbles: true, buttons: 1 }));
          view.element.setPointerCapture = () => {};
          at("pointerdown", 11, -40); at("pointerdown", 12, 40);
          at("pointermove", 11, -80); at("pointermove", 12, 80);
          at("pointerup", 11, -80); at("pointerup", 12, 80);
        }""",
        [x, y],
    )
    assert shown.evaluate(distance) == pytest.approx(was / 2, rel=0.01)


def test_a_view_follows_its_size_and_bounds_its_pixels(
    service: Up, model: SmallModel, open_window: Open
) -> None:
    page = open_window(service, device_scale_factor=3).page
    mount(page, model)
    assert page.evaluate("[view.canvas.width, view.canvas.height]") == [960, 720], (
        "at most two pixels per CSS pixel"
    )
    page.evaluate("Object.assign(box.style, { width: '300px', height: '400px' })")
    page.wait_for_function("() => view.canvas.width === 600 && view.canvas.height === 800", polling=100)
    rest(page)
    assert (camera(page)["width"], camera(page)["height"]) == (300, 400)
    page.evaluate("view.dispose()")
    assert page.locator(".view").count() == 0


def test_without_cameras_the_dense_middle_is_seen_upright(
    service: Up, model: SmallModel, visit: Visit
) -> None:
    assert mount(visit.page, model, cameras=[]) == "webgl"
    view = camera(visit.page)
    points = np.array(visit.page.evaluate("[...view.surface.points]")).reshape(-1, 3)
    assert len(points) == visit.page.evaluate("view.gaussians")
    focus = np.array(visit.page.evaluate("view.focus"))
    assert focus == pytest.approx(np.median(points, axis=0), abs=0.02)
    pose = np.array(view["camera_to_world"])
    assert pose[1, 1] > 0.9, "y points down"
    away = np.linalg.norm(pose[:3, 3] - focus)
    distances = np.linalg.norm(points - focus, axis=1)
    assert 1.2 * np.median(distances) < away < 11 * np.median(distances)
    assert psnr(pixels(visit.page), rendered(service.http, model, view)) > 25


def test_cameras_are_drawn_and_can_be_chosen(shown: Page) -> None:
    before = pixels(shown)
    shown.evaluate(
        "view.goHome(); view.showCameras(cameras.map((c, i) => ({ ...c, color: i ? 'rgb(0 255 0)' : 'rgb(255 0 0)' })))"
    )
    shown.evaluate("view.controls.zoom(3); view.moved()")
    rest(shown)
    assert np.abs(pixels(shown) - before).max() > 0.5
    assert shown.evaluate("view.overlay.tips.length") == len(shown.evaluate("cameras")), (
        "all tips are in front"
    )
    name = shown.evaluate(
        """() => new Promise((done) => {
          view.addEventListener("pick-camera", (event) => done(event.detail.name));
          const tip = view.overlay.tips[3];
          view.picked(tip.x, tip.y);
        })"""
    )
    assert name in shown.evaluate("cameras.map((c) => c.name)")
    with_frusta = pixels(shown)
    shown.evaluate("view.showCameras([])")
    rest(shown)
    assert np.abs(with_frusta - pixels(shown)).max() > 0.2


NO_WEBGL = """
const get = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
  return kind.startsWith("webgl") ? null : get.call(this, kind, ...rest);
};
"""


RENDERS = re.compile(r"/render\?")


def test_without_webgl_the_server_renders_pictures(service: Up, model: SmallModel, open_window: Open) -> None:
    visit = open_window(service)
    visit.context.add_init_script(NO_WEBGL)
    page = visit.page
    requests: list[str] = []
    page.on("request", lambda request: requests.append(request.url) if "/render?" in request.url else None)
    assert mount(page, model) == "pictures"
    assert "no WebGL" in page.evaluate("view.whyNot")

    def rested() -> None:
        query = page.evaluate("view.surface.query(view.surface.wanted, 1280)")
        page.wait_for_function("(query) => view.canvas.dataset.shown === query", arg=query, polling=100)

    rested()
    assert psnr(pixels(page), rendered(service.http, model, camera(page))) > 30
    requests.clear()
    waiting: list[Route] = []
    held = True
    page.route(RENDERS, lambda route: waiting.append(route) if held else route.continue_())
    box = page.locator(".view").bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    for step in range(30):
        page.mouse.move(x + 4 * step, y)
    page.mouse.up()
    for _ in range(500):
        if not waiting:
            page.wait_for_timeout(20)
    assert len(waiting) == len(requests) == 1, "one request at a time, not one a movement"
    held = False
    waiting[0].continue_()
    rested()
    assert psnr(pixels(page), rendered(service.http, model, camera(page))) > 30
    widths = [int(request.split("width=")[1].split("&")[0]) for request in requests]
    assert widths[0] == min(widths) == 320, "small while it moves"
    assert widths[-1] == 480, "of full size at rest"
    assert page.evaluate("troubles.filter(Boolean)") == []


def test_what_cannot_be_shown_is_said(service: Up, open_window: Open) -> None:
    visit = open_window(service)
    visit.watched.allow("404")
    page = visit.page
    page.goto("/models")
    ask = """(options) => import("/page/any/viewer.js").then(async ({ open }) => {
      const box = document.body.appendChild(document.createElement("div"));
      return open(box, options).then(() => null, (error) => [error.reason, error.message, box.childElementCount]);
    })"""
    assert page.evaluate(ask, {"url": "/v1/models/0123456789abcdef/files/model.ply"}) == [
        "unreadable",
        "The model could not be loaded: the server answered 404.",
        0,
    ]
    visit.context.add_init_script(NO_WEBGL)
    page.reload()
    reason, message, left = page.evaluate(ask, {"url": "/nothing"})
    assert (reason, left) == ("no_webgl", 0)
    assert "no WebGL" in message


def test_depth_is_shown_in_colours(service: Up, model: SmallModel, visit: Visit) -> None:
    assert mount(visit.page, model, kind="depth") == "depth"
    visit.page.wait_for_function("() => view.canvas.dataset.shown?.includes('width=480')", polling=100)
    colours = pixels(visit.page).reshape(-1, 3)
    assert len(np.unique((colours * 16).astype(int), axis=0)) > 20
    expect(visit.page.locator(".view")).to_have_attribute("data-kind", "depth")
