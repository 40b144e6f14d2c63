"""The page of a shared link in a browser without a key: the scene, downloads, the frame, and what an ended link says.

What a link opens and how it ends is tested in tests/server/models/test_shares.py; the viewer, in
../viewer/test_viewer.py; what is seen while the scene is loaded, in ../viewer/test_slow_network.py.
"""

from __future__ import annotations

import contextlib
import functools
import re
import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx
import pytest
from playwright.sync_api import Page, expect

from tests.browser.conftest import Open, SmallModel
from tests.browser.test_job_page import NO_WEBGL
from tests.browser.viewer.test_slow_network import inner
from tests.support.up import Up

DRAWN = "() => Number(document.querySelector('#view .view')?.dataset.frames) > 0"


@pytest.fixture
def link(service: Up, model: SmallModel) -> dict[str, Any]:
    return dict(service.http.post(f"/v1/models/{model.id}/shares", json={"expires_in": "1h"}).json())


def test_links_are_made_and_revoked_on_the_page(service: Up, model: SmallModel, page: Page) -> None:
    page.goto("/models?name=still")
    tile = page.get_by_role("listitem").filter(has_text="still life").first
    tile.get_by_role("button", name="Share").press("Enter")
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("Valid for").select_option("7 days")
    expect(dialog).to_contain_text("the names of the photo files")
    expect(dialog.get_by_label("Show photos too")).not_to_be_checked()
    dialog.get_by_label("For whom").fill("for mum")
    page.keyboard.press("Enter")
    link = dialog.get_by_label("The link").input_value()
    assert f'<iframe src="{link}/embed" ' in dialog.get_by_label("HTML of a frame").input_value()
    bare = httpx.get(f"{link}/model", timeout=60).json()
    assert bare["id"] == model.id
    dialog.get_by_label("Show photos too").check()
    dialog.get_by_role("button", name="Make a link").click()
    expect(dialog.get_by_role("listitem").filter(has_text="with photos")).to_have_count(1)
    whole = httpx.get(f"{dialog.get_by_label('The link').input_value()}/model", timeout=60).json()
    photos = {file["name"] for file in whole["files"]} - {file["name"] for file in bare["files"]}
    assert photos == {"held_out/000.webp", "held_out/001.webp", "report.html"}
    reach = dialog.get_by_text("Only this machine reaches 127.0.0.1")
    shown = dialog.get_by_label("The link")
    expect(shown).to_be_focused()
    assert shown.evaluate("(field) => getSelection().toString() === field.value")
    boxes = [
        each.bounding_box()
        for each in (dialog, reach, shown, dialog.get_by_role("button", name="Copy the HTML"))
    ]
    around, hint, address, last = [box for box in boxes if box is not None]
    assert around["y"] <= hint["y"] < hint["y"] + hint["height"] <= address["y"], "it is read before the link"
    assert last["y"] + last["height"] <= around["y"] + around["height"], (
        "all of it lies in the dialog's window"
    )
    entry = dialog.get_by_role("listitem").filter(has_text="for mum")
    expect(entry).to_contain_text("valid until")
    entry.get_by_role("button", name="Revoke").click()
    expect(entry).to_contain_text("revoked")
    expect(dialog.get_by_label("The link")).to_be_visible()  # that is another one
    dialog.get_by_role("listitem").filter(has_text="with photos").get_by_role("button").click()
    expect(dialog.get_by_label("The link")).to_have_count(0)
    assert httpx.get(f"{link}/model", timeout=60).status_code == 410
    page.keyboard.press("Escape")
    expect(dialog).to_be_hidden()
    page.goto(f"/models/{model.id}")
    page.get_by_role("button", name="Share").click()
    expect(page.get_by_role("dialog").get_by_role("listitem").filter(has_text="for mum")).to_contain_text(
        "revoked"
    )


def test_a_link_shows_the_scene_and_its_files(
    service: Up, model: SmallModel, link: dict[str, Any], open_window: Open
) -> None:
    service.http.get(f"/v1/models/{model.id}/download/sog", timeout=60)
    visit = open_window(service)
    asked: list[str] = []
    visit.page.on("request", lambda request: asked.append(request.url))
    visit.page.goto(link["path"])
    visit.page.wait_for_function(f"() => ({DRAWN})() && !document.querySelector('.view img')", polling=50)
    expect(visit.page.get_by_role("heading", level=1)).to_have_text("still life")
    expect(visit.page.locator("#figures")).to_contain_text("Gaussians")
    base = str(service.http.base_url).rstrip("/")
    allowed = (f"{base}{link['path']}", f"{base}/page/", f"{base}/vendor/", "blob:", "data:")
    assert not [url for url in asked if not url.startswith(allowed)], "it needs nothing that asks for a key"

    with visit.page.expect_download() as downloading:
        visit.page.locator("#downloads a[href$='/download/ply']").click()
    assert downloading.value.suggested_filename == "still life.ply"
    stored = service.http.get(f"/v1/models/{model.id}/files/model.ply").content
    assert downloading.value.path().read_bytes() == stored
    assert f'{link["path"]}/embed"' in visit.page.get_by_label("HTML of a frame").input_value()


@pytest.mark.parametrize("below", ["", "/embed"], ids=["page", "frame"])
def test_without_webgl_visitors_see_pictures_by_the_server_or_are_told_why_not(
    service: Up, link: dict[str, Any], open_window: Open, below: str
) -> None:
    visit = open_window(service)
    visit.context.add_init_script(NO_WEBGL)
    visit.watched.allow("status of 503")
    page = visit.page
    busy = {"code": "renderer_unavailable", "status": 503, "title": "Busy", "detail": "The renderer is busy."}
    page.route("**/render?*", lambda route: route.fulfill(status=503, json=busy), times=1)
    page.goto(link["path"] + below)
    # The model's picture stays meanwhile, and another attempt follows.
    expect(page.locator(".view > .said")).to_have_text("The renderer is busy.")
    expect(page.locator(".view img")).to_be_visible()
    page.locator(".view canvas[data-shown]").wait_for()
    expect(page.locator(".view img")).to_have_count(0)
    expect(page.locator(".view > .said")).to_be_empty()
    expect(page.locator(".notice")).to_have_count(0)
    assert inner(page.locator("#view")).std() > 0.05


@contextlib.contextmanager
def elsewhere(folder: Path) -> Iterator[str]:
    """Serve a folder on another port, which is another origin; yields its address."""
    handler = functools.partial(QuietHandler, directory=str(folder))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


class QuietHandler(SimpleHTTPRequestHandler):
    """Serves files and says nothing."""

    def log_message(self, format: str, *args: Any) -> None: ...


def test_only_the_viewer_alone_can_be_framed_by_a_page_of_others(
    service: Up, link: dict[str, Any], open_window: Open, tmp_path: Path
) -> None:
    visit = open_window(service)
    visit.page.goto(link["path"] + "/embed")
    expect(visit.page.get_by_role("link", name="Open the page")).to_have_attribute("href", link["path"])

    base = str(service.http.base_url).rstrip("/")
    (tmp_path / "index.html").write_text(
        f"""<!doctype html><title>a page of others</title><link rel="icon" href="data:,">
        <iframe id="frame" src="{base}{link["path"]}/embed"></iframe>
        <iframe id="page" src="{base}{link["path"]}"></iframe>"""
    )
    with elsewhere(tmp_path) as address:
        others = open_window(address)
        others.watched.allow("request to another host")
        others.watched.allow("frame-ancestors|Refused to frame|refused to display|X-Frame-Options")
        others.page.goto("/")
        inside = others.page.frame_locator("#frame")
        expect(inside.get_by_role("heading", level=1)).to_have_text("still life")
        expect(inside.locator("#view .view")).to_be_visible()
        expect(others.page.frame_locator("#page").locator("#title")).to_have_count(0)
        assert [text for text in others.watched.complaints if "frame" in text.lower()]


def test_the_frame_is_as_wide_as_its_column_and_keeps_its_shape(
    link: dict[str, Any], service: Up, open_window: Open, tmp_path: Path
) -> None:
    visit = open_window(service)
    visit.page.goto(link["path"])
    embed = visit.page.get_by_label("HTML of a frame")
    expect(embed).to_have_value(re.compile("<iframe "))
    frame = embed.input_value()
    (tmp_path / "index.html").write_text(
        f"""<!doctype html><title>a page of others</title><link rel="icon" href="data:,"><body style="margin: 0">
        <div id="column">{frame}</div>"""
    )
    with elsewhere(tmp_path) as address:
        others = open_window(address)
        others.watched.allow("request to another host")
        others.page.goto("/")
        for column, width in ((320, 320), (1200, 800)):
            others.page.evaluate(f"document.getElementById('column').style.width = '{column}px'")
            box = others.page.locator("iframe").bounding_box()
            assert box is not None
            assert box["width"] == width
            assert box["height"] == pytest.approx(width * 5 / 8, abs=1)


def test_an_ended_link_says_so(
    service: Up, model: SmallModel, link: dict[str, Any], open_window: Open
) -> None:
    service.http.delete(f"/v1/models/{model.id}/shares/{link['id']}")
    visit = open_window(service)
    visit.watched.allow("status of 410")
    visit.watched.allow("status of 404")
    visit.page.goto(link["path"])
    expect(visit.page.get_by_role("alert")).to_contain_text("was revoked")
    expect(visit.page.get_by_role("alert")).to_contain_text("Ask whoever sent it for a new one.")
    expect(visit.page.get_by_role("heading", name="Download")).to_be_hidden()
    visit.page.goto("/s/nothing")
    expect(visit.page.get_by_role("alert")).to_contain_text("no such shared link")
