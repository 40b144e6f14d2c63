"""A large model is loaded in parts: the coarsest level first, from few bytes, and at last it is drawn as the whole is.

What the archive holds is tested in tests/worker/splat/formats/test_streamed_zip.py.
"""

from __future__ import annotations

import io
import json
import re
import secrets
import shutil
import time
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import torch
from PIL import Image
from playwright.sync_api import Page, Route, expect

from splatmill_worker.splat.formats import ply
from splatmill_worker.splat.gaussians import Gaussians, concatenate
from tests.browser.conftest import Open, SmallModel, requests
from tests.browser.viewer.test_slow_network import DRAWN, SLOW, slowed
from tests.support.up import Up
from tests.support.waiting import wait_for

WHOLE = 2**18
"""Gaussians up to which a model is loaded whole."""

FIRST_PICTURE = 2_000_000
"""Most bytes until the scene is drawn: the page, its engine, and those of the model."""

SMALL = {"width": 800, "height": 500}
"""A window of which little is to be drawn."""

SOONER = (
    "{ const real = setTimeout; window.setTimeout = (call, ms, ...more) => real(call, ms / 10, ...more); }"
)
"""Lets a page wait a tenth of its pauses."""

SETTLED = "() => document.querySelector('.view')?.dataset.settled === 'true'"


def _many(few: Gaussians) -> Gaussians:
    """The Gaussians without colours that depend on the view, among many that are hardly to be seen."""
    few = replace(few, sh=few.sh[:, :1])
    dust = few.select(torch.arange(few.count).repeat_interleave(WHOLE // few.count + 1))
    generator = torch.Generator().manual_seed(0)
    dust.means[:] += dust.log_scales.exp() * torch.randn(dust.means.shape, generator=generator)
    dust.log_scales[:] = -9
    dust.logit_opacities[:] = -5
    return concatenate(few, dust)


@pytest.fixture(scope="module")
def large(service: Up, model: SmallModel) -> Iterator[str]:
    """The id of the small model with many more Gaussians, whose levels of detail are made."""
    models = service.data / "storage/models"
    large = models / secrets.token_hex(8)
    shutil.copytree(models / model.id, large, ignore=shutil.ignore_patterns("formats", "orbits", "meshes"))
    scene = ply.read(large / "model.ply")
    ply.write(large / "model.ply", _many(scene.gaussians), offset=scene.offset)
    record = json.loads((large / "job.json").read_text())
    (large / "job.json").write_text(
        json.dumps(record | {"id": large.name, "model": large.name, "sha256": {}})
    )
    answer = service.http.head(f"/v1/models/{large.name}/download/lod.zip", timeout=600)
    assert answer.status_code == 200
    yield large.name
    shutil.rmtree(large)


def _picture(page: Page) -> npt.NDArray[np.float64]:
    with Image.open(io.BytesIO(page.locator(".view canvas").first.screenshot())) as shown:
        return np.asarray(shown.convert("RGB")) / 255.0


def _psnr(one: npt.NDArray[np.float64], other: npt.NDArray[np.float64]) -> float:
    return float(-10 * np.log10(max(np.square(one - other).mean(), 1e-12)))


def test_the_first_picture_comes_from_few_bytes_and_the_last_is_that_of_the_whole(
    service: Up, large: str, open_window: Open
) -> None:
    visit = open_window(service, viewport=SMALL)
    page = visit.page
    loaded = slowed(visit, {**SLOW, "downloadThroughput": 1_000_000})
    asked = requests(page)
    ranges: list[str] = []
    page.on("request", lambda request: ranges.append(request.headers.get("range", "")))
    page.on("requestfinished", lambda request: ranges.append("end of " + request.headers.get("range", "")))
    page.goto(f"/models/{large}", wait_until="commit")
    page.wait_for_function(DRAWN, polling=50)
    assert sum(loaded) < FIRST_PICTURE
    coarsest = _ranges(service, large)[-1]
    assert [each for each in ranges[: ranges.index(f"end of {coarsest}")] if each.startswith("bytes=")] == [
        "bytes=-65536",
        coarsest,
    ], "nothing takes bytes from the coarsest level"
    assert not page.evaluate(SETTLED)
    page.wait_for_function(SETTLED)
    parts = [line for line in asked if line.startswith("GET") and line.endswith("/download/lod.zip")]
    assert len(parts) == 1 + len(_ranges(service, large)), "the end, and each chunk once"
    in_parts = _picture(page)

    # An edit needs to know where each Gaussian is: the whole model takes the place of its parts.
    assert not [line for line in asked if line.endswith("/download/sog")]
    with page.expect_request("**/download/sog"):
        page.get_by_role("button", name="Crop and clean").click()
    expect(page.locator(".view .said")).to_be_empty()
    page.get_by_role("button", name="Brush").click()
    page.get_by_role("button", name="Select in the middle").click()
    expect(page.get_by_text(re.compile(r"[1-9][\d,]* of 26[\d,]+ Gaussians are selected"))).to_be_visible()
    page.get_by_role("button", name="Crop and clean").click()
    page.evaluate("scrollTo(0, 0)")  # the view is where it was
    wait_for(lambda: _psnr(_picture(page), in_parts) > 35)


def _ranges(service: Up, large: str) -> list[str]:
    """The ranges of bytes of the chunks, the coarsest level last."""
    answer = service.http.get(f"/v1/models/{large}/download/lod.zip")
    begins: dict[str, int] = {}
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        for entry in archive.infolist():
            begins.setdefault(entry.filename.rpartition("/")[0], entry.header_offset)
    return [f"bytes={begin}-{end - 1}" for begin, end in pairwise(sorted(begins.values()))]


def test_a_link_shows_it_in_parts_and_a_part_that_fails_is_asked_for_again(
    service: Up, large: str, open_window: Open
) -> None:
    link = service.http.post(f"/v1/models/{large}/shares", json={"expires_in": "1h"}).json()["path"]
    visit = open_window(service, viewport=SMALL)
    visit.watched.allow("ERR_FAILED|ERR_ABORTED")
    visit.page.add_init_script(SOONER)
    failures = ["lost", "busy", "silent"]
    asked: list[tuple[str, str, float]] = []

    def sometimes(route: Route) -> None:
        span = route.request.headers.get("range", "bytes=-")
        failure = failures.pop(0) if failures and not span.startswith("bytes=-") else ""
        asked.append((span, failure, time.monotonic()))
        if failure == "lost":
            route.abort()
        elif failure == "busy":
            route.fulfill(status=429, headers={"Retry-After": "20"})
        elif not failure:
            route.continue_()

    visit.watched.allow("429")
    visit.page.route("**/download/lod.zip", sometimes)
    visit.page.goto(link)
    visit.page.wait_for_function(SETTLED)
    expect(visit.page.locator(".view .said")).to_be_empty()
    for part, failure, at in asked:
        later = [then for other, _, then in asked if other == part and then > at]
        assert bool(later) == bool(failure), "what failed is asked for again, and nothing else"
        assert failure != "busy" or later[0] - at > 1.5, "not before the server says"

    # What fails for as long as it is asked for is given up, and comes when the network is there again.
    finest = _ranges(service, large)[0]
    visit.page.unroute("**/download/lod.zip")
    visit.page.route(
        "**/download/lod.zip",
        lambda route: route.abort() if route.request.headers.get("range") == finest else route.continue_(),
    )
    visit.page.reload()
    said = "A part of the model is shown without its details"
    expect(visit.page.locator(".view .said")).to_contain_text(said)
    visit.page.unroute("**/download/lod.zip")
    visit.page.evaluate("dispatchEvent(new Event('online'))")
    expect(visit.page.locator(".view .said")).to_be_empty()

    visit.watched.allow("404")
    visit.page.route("**/download/lod.zip", lambda route: _refuse(route, _ranges(service, large)[:-1]))
    visit.page.reload()
    expect(visit.page.locator(".view .said")).to_contain_text(said)
    expect(visit.page.locator(".view .said")).to_contain_text("the server answered 404")
    visit.page.locator(".view").press("ArrowLeft")
    visit.page.locator(".view").press("w")
    expect(visit.page.locator(".view .said")).to_contain_text("the server answered 404")
    assert len(set(np.round(_picture(visit.page) * 255).astype(int).flatten())) > 100, (
        "the coarsest level is drawn"
    )


def _refuse(route: Route, ranges: list[str]) -> None:
    if route.request.headers.get("range") in ranges:
        route.fulfill(status=404)
    else:
        route.continue_()


def test_why_nothing_is_shown_is_said(service: Up, large: str, open_window: Open) -> None:
    visit = open_window(service, viewport=SMALL)
    visit.watched.allow("503")
    page = visit.page

    def end_only(route: Route) -> None:
        if route.request.headers.get("range", "bytes=-").startswith("bytes=-"):
            route.continue_()
        else:
            route.fulfill(status=503)

    page.route("**/download/lod.zip", end_only)
    page.goto(f"/models/{large}")
    expect(page.get_by_text("could not be loaded in parts: the server answered 503")).to_be_visible()
    page.unroute("**/download/lod.zip")
    page.route("**/download/lod.zip", lambda route: route.fulfill(status=200, body=b"PK"))
    page.reload()
    expect(page.get_by_text("a proxy before it, sends no parts of files")).to_be_visible()


def test_a_file_in_parts_is_opened_and_what_is_none_is_refused_by_name(
    service: Up, large: str, open_window: Open, tmp_path: Path
) -> None:
    page = open_window(service, viewport=SMALL).page
    whole = service.http.get(f"/v1/models/{large}/download/lod.zip").content
    odd = {
        "sog": service.http.get(f"/v1/models/{large}/download/sog", timeout=120).content,
        "cut": whole[:-1],
        "empty": b"",
    }
    page.goto("/open")
    for name, contents in odd.items():
        (tmp_path / f"{name}.lod.zip").write_bytes(contents)
        page.get_by_label("Choose a file").set_input_files(tmp_path / f"{name}.lod.zip")
        expect(page.get_by_role("alert")).to_contain_text(
            f"{name}.lod.zip: The model could not be read as levels"
        )
    (tmp_path / "mine.lod.zip").write_bytes(whole)
    page.get_by_label("Choose a file").set_input_files(tmp_path / "mine.lod.zip")
    expect(page.get_by_role("heading", level=1)).to_have_text("mine.lod.zip")
    page.wait_for_function(SETTLED)
    assert len(set(np.round(_picture(page) * 255).astype(int).flatten())) > 100
