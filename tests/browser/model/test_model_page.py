"""The page of a model in a real browser: the comparison with held-out photos, the tools of the viewer, downloads, orbit
videos, deleting; on a phone, by keyboard, and for a screen reader.

Does not prove what the viewer draws: tests/browser/viewer/test_viewer.py does.
"""

from __future__ import annotations

import io
import json
import re
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from playwright.sync_api import Locator, Page, expect

from tests.browser.conftest import Open, SmallModel, Visit
from tests.support.paths import ROOT
from tests.support.programs import npm_package
from tests.support.up import Up
from tests.support.waiting import wait_for

WAIT = 60_000
"""Milliseconds to wait for what the renderer answers, which other tests may keep busy."""


def show(page: Page, model: SmallModel) -> None:
    page.goto(f"/models/{model.id}")
    expect(page.locator("#viewer[data-ready]")).to_be_visible(timeout=WAIT)


@pytest.fixture
def shown(page: Page, model: SmallModel) -> Page:
    show(page, model)
    return page


FOR_PROGRAMS = re.compile(r"(GET|POST|PUT|DELETE) /|/v1/|image_size|registered|harmonics are|\b1 \w+s\b")
"""Words of the API and of the field that pages for people do without."""


def test_figures_and_settings_are_in_plain_words_with_a_link_to_what_they_mean(shown: Page) -> None:
    words = ["rough", "recognisable", "good", "hard to tell from the photos"]
    quality = """async (all) => {
      const { qualityOf } = await import("/page/any/figures.js");
      return all.map(qualityOf);
    }"""
    assert shown.evaluate(quality, [19.9, 20, 25, 30]) == words
    expect(shown.locator("#lead")).to_contain_text(
        re.compile(r"(rough|recognisable), [0-9.]+ dB on photos that it")
    )
    expect(shown.locator("#downloads")).to_contain_text("view-dependent colour", timeout=WAIT)
    assert not FOR_PROGRAMS.findall(shown.inner_text("main"))
    assert " bits" not in shown.inner_text("#downloads"), "what a format loses is behind a fold"
    shown.locator("#lead .term").last.click()
    expect(shown.locator("dt:target")).to_have_text("dB, PSNR")
    explained = (ROOT / "docs" / "report.md").read_text()
    for word in words:  # the glossary and the documentation explain them all
        expect(shown.locator("#quality-words")).to_contain_text(word)
        assert f"*{word}*" in explained
    assert shown.evaluate("document.documentElement.scrollWidth <= innerWidth")
    shown.goto("/")
    shown.locator("html[data-ready]").wait_for()
    assert not FOR_PROGRAMS.findall(shown.locator("main").text_content() or "")


def test_the_model_is_compared_with_its_held_out_photos(service: Up, model: SmallModel, shown: Page) -> None:
    cameras = service.http.get(f"/v1/models/{model.id}/cameras").json()["cameras"]
    held = {camera["name"]: camera for camera in cameras if camera["split"] == "test"}
    section = shown.locator("#compare")
    buttons = section.locator(".photos button")
    assert buttons.count() == len(held) == 2
    worst = min(held.values(), key=lambda camera: float(camera["psnr"]))
    section.get_by_label("Order of the photos").select_option("worst")
    expect(buttons.first).to_contain_text(worst["name"])
    for name, camera in held.items():
        section.get_by_role("button", name=name).click()
        figures = f"{name}: PSNR {camera['psnr']:.1f} dB, SSIM {camera['ssim']:.3f}"
        expect(section.locator("figcaption")).to_have_text(figures)
        sizes = """() => [...document.querySelectorAll('.pair img')].map((i) => [i.naturalWidth, i.naturalHeight])"""
        size = [camera["camera"]["width"], camera["camera"]["height"]]
        shown.wait_for_function(
            f"([w, h]) => ({sizes})().every(([x, y]) => x === w && y === h)", arg=size, polling=100
        )
    error = """() => {
          const [render, photo] = [...document.querySelectorAll(".pair img")].map((image) => {
            const canvas = document.createElement("canvas");
            [canvas.width, canvas.height] = [image.naturalWidth, image.naturalHeight];
            canvas.getContext("2d").drawImage(image, 0, 0);
            return canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
          });
          let sum = 0;
          for (let i = 0; i < render.length; i += 4)
            for (let c = 0; c < 3; c++) sum += ((render[i + c] - photo[i + c]) / 255) ** 2;
          return -10 * Math.log10(sum / (render.length / 4) / 3);
        }"""
    # The pictures have the error that is written under them, once both are those of this photo.
    wait_for(lambda: shown.evaluate(error) == pytest.approx(camera["psnr"], abs=0.05))
    slider = section.get_by_role("slider")
    slider.focus()
    shown.keyboard.press("Home")
    assert shown.locator(".pair").evaluate("(pair) => pair.style.getPropertyValue('--cut')") == "0%"
    box = shown.locator(".pair").bounding_box()
    assert box is not None
    shown.locator(".pair").click(position={"x": 0.75 * box["width"], "y": 0.5 * box["height"]})
    assert int(slider.input_value()) == pytest.approx(75, abs=1)


def test_the_tools_of_the_view_are_in_sight(shown: Page) -> None:
    toolbar = shown.locator("#toolbar").bounding_box()  # in a window of 1280 by 800 pixels
    assert toolbar is not None
    assert toolbar["y"] + toolbar["height"] < 800
    title, share = (
        each.bounding_box() for each in (shown.locator("#title"), shown.get_by_role("button", name="Share"))
    )
    assert title is not None
    assert share is not None
    assert abs(title["y"] + title["height"] / 2 - share["y"] - share["height"] / 2) < 20, "they share a line"


def test_distances_are_measured_in_a_unit_that_is_set(shown: Page) -> None:
    shown.get_by_role("button", name="Measure").click()
    panel = shown.locator("form.panel").first
    panel.get_by_role("button", name="Set the scale").click()
    expect(panel.get_by_role("status")).to_contain_text("Mark two points first")
    expect(panel.get_by_role("button", name="Mark the point in the middle")).to_be_focused()
    panel.get_by_role("button", name="Mark the point in the middle").click()
    expect(panel.get_by_role("status")).to_have_text("Click a second point in the view.", timeout=WAIT)
    box = shown.locator(".view").bounding_box()
    assert box is not None
    shown.locator(".view").click(position={"x": 0.5 * box["width"], "y": 0.6 * box["height"]})
    expect(panel.get_by_role("status")).to_contain_text("units apart", timeout=WAIT)
    panel.get_by_role("button", name="Set the scale").click()
    expect(panel.get_by_role("status")).to_contain_text("a number over 0")
    expect(panel.get_by_label("Its true length")).to_be_focused()
    panel.get_by_label("Its true length").fill("12")
    panel.get_by_role("button", name="Set the scale").click()
    expect(panel.get_by_role("status")).to_have_text("The points are 12 cm apart.", timeout=WAIT)
    panel.get_by_role("button", name="Forget the scale").click()
    expect(panel.get_by_role("status")).to_have_text("Lengths are in units of the model.", timeout=WAIT)


def test_the_view_is_changed_by_its_tools(shown: Page) -> None:
    note = shown.locator("#viewer-note")
    expect(note).to_contain_text("Drag or arrow keys")
    cameras = shown.get_by_role("button", name="Cameras", exact=True)
    cameras.click()
    expect(note).to_contain_text("Orange: held out")
    cameras.click()
    expect(note).to_contain_text("Drag or arrow keys")
    cameras.click()
    shown.get_by_text(re.compile("Cameras: 14 photos, 2 of them held out")).click()
    shown.get_by_role("button", name="Look from 03.png").click()
    expect(shown.locator("#viewer-note")).to_have_text("The view of 03.png.")
    with shown.expect_response(re.compile("/files/time_lapse/")):
        shown.get_by_label("Time-lapse").fill("0")
    expect(shown.locator(".view .said")).to_be_empty()  # no words about loading stay
    scrubber = shown.locator(".scrubber")
    scrubber.get_by_role("button", name="Play").click()
    expect(scrubber.locator("output")).to_contain_text("the finished model")
    expect(scrubber.get_by_role("button", name="Play")).to_be_visible()  # it has come to the end
    expect(shown.locator(".view .said")).to_be_empty()
    # The ring of the focus is seen at the edge of the canvas.
    shown.keyboard.press("Shift")
    shown.locator(".view").focus()
    ring = Image.open(io.BytesIO(shown.locator(".view").screenshot())).convert("RGB").getpixel((100, 1))
    assert ring == (0x8F, 0xB2, 0xFF)
    shown.get_by_label("Kind of view").select_option("depth")
    expect(shown.locator("#viewer[data-ready=depth] .depth-scale, .depth-scale")).to_contain_text(
        "units", timeout=WAIT
    )
    shown.get_by_label("Kind of view").select_option("webgl")
    expect(shown.locator(".view[data-kind=webgl]")).to_be_visible()
    assert shown.locator(".view").count() == 1


def test_files_and_the_orbit_video_are_there(
    service: Up, model: SmallModel, shown: Page, tmp_path: Path
) -> None:
    with shown.expect_download() as downloading:
        shown.locator("#downloads").get_by_role("link", name="model.ply").click()
    size = service.http.get(f"/v1/models/{model.id}").json()["bytes"]
    downloading.value.save_as(tmp_path / "model.ply")
    assert (tmp_path / "model.ply").stat().st_size == size
    length, said = shown.get_by_label("Length, in seconds"), shown.locator("#orbit .hint")
    for impossible in ("", "0.1", "61"):
        length.fill(impossible)
        shown.get_by_role("button", name="Make the video").click()
        expect(said).to_have_text("A video has 0.5 to 60 seconds.")
        expect(length).to_be_focused()
        expect(length).to_have_attribute("aria-invalid", "true")
        shown.get_by_label("The camera").focus()
    length.fill("4")
    shown.get_by_role("button", name="Make the video").click()
    shown.get_by_role("button", name="Stop").click()
    expect(shown.locator("#orbit .hint")).to_have_text("Stopped.")
    assert service.http.get(f"/v1/models/{model.id}/orbits").json()["orbits"] == []
    # One that is rendered while no page is open is there when one is opened.
    wish = {"seconds": 0.5, "fps": 8, "width": 64, "height": 48}
    made = service.http.post(f"/v1/models/{model.id}/orbits", json=wish).json()
    shown.reload()
    shown.get_by_role("button", name="Play circle, 64 x 48, 0.5 seconds").click(timeout=WAIT)
    video = shown.locator("#orbit video")
    expect(video).to_have_attribute("src", made["links"]["video"])
    shown.wait_for_function("() => document.querySelector('#orbit video').duration === 0.5", polling=100)
    shown.get_by_role("button", name="Delete the video circle, 64 x 48").click()
    expect(video).to_have_count(0)
    assert service.http.get(made["links"]["self"]).status_code == 404


def test_a_format_is_made_when_it_is_asked_for_and_its_row_is_told_anew(
    service: Up, model: SmallModel, shown: Page, tmp_path: Path
) -> None:
    address = f"/v1/models/{model.id}"
    section = shown.locator("#downloads")

    def row(link: str) -> Locator:
        return section.get_by_role("row").filter(has=shown.get_by_role("link", name=link))

    def known(format: str) -> dict[str, Any]:
        formats = service.http.get(f"{address}/formats").json()["formats"]
        return next(each for each in formats if each["format"] == format)

    whole = service.http.get(address).json()
    size, psnr = (row("model.ply").get_by_role("cell").nth(index) for index in (1, 2))
    expect(size).to_have_text(f"{whole['bytes'] / 1000:.0f} kB")
    expect(psnr).to_have_text(f"{whole['psnr']:.2f} dB")
    assert known("glb")["bytes"] is None, "another test has made it"
    glb = row("binary glTF")
    expect(glb.get_by_role("cell").nth(1)).to_have_text("made on demand")
    with shown.expect_download(timeout=WAIT) as downloading:
        glb.get_by_role("link").click()
    downloading.value.save_as(tmp_path / "model.glb")
    made = known("glb")
    assert (tmp_path / "model.glb").stat().st_size == made["bytes"]
    expect(glb.get_by_role("cell").nth(1)).to_have_text(f"{made['bytes'] / 1000:.0f} kB", timeout=WAIT)
    expect(glb.get_by_role("cell").nth(2)).to_contain_text(f"{made['conversion']['psnr']:.2f} dB")
    expect(glb.get_by_role("cell").nth(2)).to_contain_text("as model.ply")
    expect(section.get_by_role("status")).to_be_empty()
    for link, name, start in (
        ("Page in one file", "html", b"<!doctype html>"),
        ("cameras.zip", "zip", b"PK"),
    ):
        with shown.expect_download(timeout=WAIT) as downloading:
            row(link).get_by_role("link").click()
        downloading.value.save_as(tmp_path / name)
        assert (tmp_path / name).read_bytes().startswith(start)
    expect(row("SOG, version 2").get_by_role("cell").nth(1)).to_contain_text("kB", timeout=WAIT)


def test_why_a_format_is_not_made_stays_while_another_one_is(
    visit: Visit, shown: Page, model: SmallModel
) -> None:
    problem = {
        "type": "about:blank",
        "title": "No",
        "status": 507,
        "detail": "The disk is full.",
        "code": "storage_full",
    }
    visit.watched.allow("507")
    shown.route(
        f"**/v1/models/{model.id}/**spz*",
        lambda route: route.fulfill(
            status=507, content_type="application/problem+json", body=json.dumps(problem)
        ),
    )
    section = shown.locator("#downloads")
    section.get_by_role("link", name=".spz").click()
    expect(section.get_by_role("status")).to_contain_text("The disk is full.")
    with shown.expect_download(timeout=WAIT):
        section.get_by_role("link", name="compressed .ply").click()
    expect(section.get_by_role("status").locator(".hint")).to_have_count(0, timeout=WAIT)
    expect(section.get_by_role("status")).to_contain_text("The disk is full.")


def test_a_phone_shows_the_whole_page(service: Up, model: SmallModel, open_window: Open) -> None:
    page = open_window(service, viewport={"width": 360, "height": 740}, color_scheme="dark").page
    show(page, model)
    page.get_by_role("button", name="Measure").click()
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    expect(page.get_by_role("link", name="Page in one file")).to_be_attached(timeout=WAIT)
    table = page.locator("#downloads .scroll")
    assert table.evaluate("(table) => table.scrollWidth <= table.clientWidth"), (
        "sizes are seen without scrolling"
    )


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_assistive_technology_finds_nothing_serious(
    service: Up, model: SmallModel, open_window: Open, scheme: str
) -> None:
    page = open_window(service, color_scheme=scheme).page
    show(page, model)
    page.get_by_role("button", name="Measure").click()
    page.evaluate((npm_package("axe-core") / "axe.min.js").read_text())
    problems = page.evaluate("axe.run().then((result) => result.violations)")
    serious = [
        f"{v['id']}: {v['nodes'][0]['html']}" for v in problems if v["impact"] in ("serious", "critical")
    ]
    assert not serious


def test_a_model_that_is_not_there_is_said(visit: Visit) -> None:
    visit.watched.allow("404")
    visit.page.goto("/models/0123456789abcdef")
    alert = visit.page.get_by_role("alert")
    expect(alert).to_contain_text("There is no model '0123456789abcdef'.")
    expect(alert).to_contain_text("The list of models shows those that are there.")
    assert "/v1/" not in visit.page.inner_text("main")


def test_deleting_asks_first(model: SmallModel, shown: Page) -> None:
    shown.get_by_role("button", name="Delete").click()
    dialog = shown.get_by_role("dialog")
    said = dialog.locator("p").inner_text()
    assert "The model stays in the bin for a day, and can be restored there." in said
    bin_text = "async () => (await import('/page/any/bin.js')).binText('model', 1)"
    assert said == shown.evaluate(bin_text), "as the lists say it afterwards"
    dialog.get_by_role("button", name="Cancel").click()
    expect(dialog).to_have_count(0)
    assert shown.url.endswith(model.id)


def test_a_crop_makes_a_new_model_and_keeps_the_first(service: Up, model: SmallModel, shown: Page) -> None:
    first = service.http.get(f"/v1/models/{model.id}").json()
    models = service.http.get("/v1/models").json()["models"]
    shown.get_by_role("button", name="Crop and clean").click()
    panel = shown.get_by_role("form", name="Crop and clean")
    opacity, kept = panel.get_by_label("Least opacity"), panel.get_by_label("Keep only what lies in the box")
    opacity.fill("2")
    panel.get_by_role("button", name="Measure what it does").click()
    expect(panel.get_by_role("status")).to_contain_text("from 0 to 0.99")
    expect(opacity).to_be_focused()
    opacity.fill("0")
    kept.uncheck()
    panel.get_by_role("button", name="Make a new model").click()
    expect(panel.get_by_role("status")).to_contain_text("Nothing would change")
    expect(kept).to_be_focused()
    kept.check()
    ends = [panel.get_by_label(f"The box along x, {end}") for end in ("from", "to")]
    low, high = (float(end.input_value()) for end in ends)
    ends[0].fill(str((low + high) / 2))
    ends[0].press("Tab")
    assert shown.evaluate("document.querySelectorAll('.view canvas').length") == 2
    panel.get_by_role("button", name="Measure what it does").click()
    said = re.compile(r"^[\d,]+ of [\d,]+ Gaussians would be left out, and [\d,]+ would stay: the ")
    expect(panel.get_by_role("status").locator("p")).to_have_text(said, timeout=WAIT)
    assert service.http.get("/v1/models").json()["models"] == models, "a preview makes no model"
    panel.get_by_role("button", name="Make a new model").click()
    panel.get_by_role("link", name="Open the new model").click(timeout=WAIT)
    expect(shown.locator("#viewer[data-ready]")).to_be_visible(timeout=WAIT)
    made = service.http.get(f"/v1/models/{shown.url.rsplit('/', 1)[-1]}").json()
    assert made["id"] != model.id
    assert 0 < made["gaussians"] < first["gaussians"]
    assert (made["name"], made["psnr"]) == ("still life, cropped", None), "the photos show what was cropped"
    expect(shown.locator("#lead")).to_contain_text("its quality was not measured")
    cameras = service.http.get(f"/v1/models/{made['id']}/cameras").json()["cameras"]
    held = [camera for camera in cameras if camera["split"] == "test"]
    assert {camera["psnr"] for camera in held} == {None}
    assert service.http.get(f"/v1/models/{made['id']}/files/{held[0]['photo']}").status_code == 200
    expect(shown.locator("#origin")).to_contain_text(
        "Made from still life without what lies outside of a box."
    )
    expect(shown.locator("#origin a")).to_have_attribute("href", re.compile(f"/models/{model.id}$"))
    assert "poster.jpg" in [file["name"] for file in made["files"]]
    shown.get_by_role("button", name="Delete").click()
    shown.get_by_role("button", name="Delete the model").click()
    shown.wait_for_url("**/models", timeout=WAIT)
    assert [entry["id"] for entry in service.http.get("/v1/bin").json()["entries"]] == [made["id"]]
    assert service.http.delete(f"/v1/jobs/{made['id']}").status_code == 204
    assert service.http.get(f"/v1/models/{model.id}").json() == first


def test_edits_that_make_no_sense_are_refused(service: Up, model: SmallModel) -> None:
    address = f"/v1/models/{model.id}/edits"
    for body in (
        {},
        {"box": {"min": [0, 0, 0], "max": [0, 1, 1]}},
        {"min_opacity": 2},
        {"box": {"min": [0]}},
    ):
        answer = service.http.post(address, json=body)
        assert answer.status_code == 422, answer.text
    answer = service.http.post(address, json={"max_size": 1e-9})
    assert answer.status_code == 422
    assert answer.json()["detail"] == "The edit leaves no Gaussian of the model."


def test_a_model_that_is_deleted_elsewhere_says_so(
    service: Up, model: SmallModel, shown: Page, visit: Visit
) -> None:
    visit.watched.allow("Failed to load resource")
    revisit = "document.dispatchEvent(new Event('visibilitychange'))"
    service.http.put(f"/v1/bin/jobs/{model.id}").raise_for_status()
    try:
        shown.evaluate(revisit)
        notice = shown.locator("#problem")
        expect(notice).to_contain_text("This model is in the bin, and deleted for good in 23 hours.")
        shown.reload()
        notice.get_by_role("button", name="Restore").click()
        expect(notice).to_be_empty()
        assert service.http.get("/v1/bin").json()["entries"] == []
    finally:
        service.http.delete(f"/v1/bin/jobs/{model.id}")
    shown.route(f"**/v1/models/{model.id}", lambda route: route.fulfill(status=404, json=GONE))
    shown.evaluate(revisit)
    expect(notice).to_contain_text("There is no model")


GONE = {"code": "model_not_found", "title": "No such model", "status": 404, "detail": "There is no model."}
