"""What people see over a slow connection until the scene is drawn: first its picture, with words on what is loaded, and
then the scene itself, from few bytes.

Bytes are counted here and times are not.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image
from playwright.sync_api import Locator, expect

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage
from tests.browser.conftest import Open, SmallModel, Visit, requests
from tests.support.up import Up
from tests.support.waiting import wait_for

SLOW = {"offline": False, "latency": 150, "downloadThroughput": 200_000, "uploadThroughput": 200_000}
"""1.6 Mbit/s and 150 ms, as a phone has at the edge of a cell."""

SLOWER = {**SLOW, "downloadThroughput": 60_000}
"""So slow that the server makes the small file in the time that the engine takes to load, however busy it is."""

FIRST_FRAME = 600_000
"""Most bytes until the first full frame of the scene, which is of 3000 Gaussians."""

PICTURE = {"link": 60_000, "frame": 60_000, "model": 152_000}
"""Most bytes until the picture is seen. Links come with it; the model's page has to learn first what the model has."""

FLAT = 0.02
"""Least standard deviation of what shows the scene; an empty view has none."""

DRAWN = "() => Number(document.querySelector('.view')?.dataset.frames) > 0 && !document.querySelector('.view img')"
"""Whether the scene is drawn and its picture gone."""


def inner(box: Locator) -> npt.NDArray[np.float64]:
    """The middle of a view as it is shown, without the words at its lower edge, RGB in 0 to 1."""
    with Image.open(io.BytesIO(box.screenshot())) as shown:
        pixels = np.asarray(shown.convert("RGB")) / 255.0
    height, width = pixels.shape[:2]
    side = int(0.6 * height)  # the picture is 4:3 and as high as the view
    return pixels[: int(0.85 * height), width // 2 - side : width // 2 + side]


def unmoved(box: Locator) -> list[npt.NDArray[np.float64]]:
    """The middle of a view that shows something, if it was the same twice in a row."""
    first, second = inner(box), inner(box)
    return [second] if second.std() > FLAT and np.array_equal(first, second) else []


def slowed(visit: Visit, conditions: dict[str, Any]) -> list[int]:
    """Make the network of a page slow. Returns the bytes of each part that it receives, filled as they come."""
    session, loaded = visit.context.new_cdp_session(visit.page), [0]
    session.send("Network.enable")
    session.on("Network.dataReceived", lambda part: loaded.append(part["encodedDataLength"]))
    session.send("Network.emulateNetworkConditions", conditions)
    return loaded


@pytest.mark.parametrize("where", ["link", "frame", "model"])
def test_the_picture_comes_first_and_the_scene_from_few_bytes(
    service: Up, model: SmallModel, open_window: Open, where: str, tmp_path: Path
) -> None:
    service.http.get(f"/v1/models/{model.id}/download/sog", timeout=60)
    link = service.http.post(f"/v1/models/{model.id}/shares", json={"expires_in": "1h"}).json()["path"]
    address = {"link": link, "frame": f"{link}/embed", "model": f"/models/{model.id}"}[where]
    box = "#viewer" if where == "model" else "#view"
    visit = open_window(service)
    page = visit.page
    loaded = slowed(visit, SLOW)
    asked = requests(page)
    page.goto(address, wait_until="commit")
    # An image has its width as soon as its head has come.
    condition = (
        f"[...document.querySelectorAll('{box} img')].some((img) => img.complete && img.naturalWidth > 0)"
    )
    page.wait_for_function(f"() => {condition}", polling=50)
    assert sum(loaded) < PICTURE[where], "the picture comes before the engine"
    # A picture that has come is shown once it is decoded, and the page moves once more when its title comes.
    (poster,) = wait_for(lambda: unmoved(page.locator(box)))
    expect(page.locator(".view .said")).to_contain_text("Loading")
    page.wait_for_function(DRAWN, polling=50)
    assert sum(loaded) < FIRST_FRAME
    expect(page.locator(".view .said")).to_be_empty()
    # A frame that was drawn is shown a moment later.
    alike: list[float] = []

    def like_the_picture() -> bool:
        alike.append(float(-10 * np.log10(np.square(inner(page.locator(box)) - poster).mean())))
        return alike[-1] > 25

    try:
        wait_for(like_the_picture)
    except AssertionError as error:
        Image.fromarray((255 * poster).astype(np.uint8)).save(tmp_path / "poster.png")
        page.screenshot(path=tmp_path / "view.png")
        raise AssertionError(
            f"the view is like its picture by {alike[0]:.1f} dB, later {alike[-1]:.1f}; {tmp_path}"
        ) from error
    assert not [line for line in asked if line.endswith("/model.ply")]


@pytest.fixture
def unmade(service: Up, model: SmallModel) -> SmallModel:
    """The model before anybody has asked for a small file of it."""
    wait_for(lambda: service.http.head(f"/v1/models/{model.id}/download/sog").is_success, 60)
    storage = Storage((service.data / "storage").as_uri())
    storage.delete(layout.conversion_record(model.id, "sog"))
    storage.delete(layout.conversion(model.id, "sog"))
    (small,) = (
        form
        for form in service.http.get(f"/v1/models/{model.id}/formats").json()["formats"]
        if form["format"] == "sog"
    )
    assert small["bytes"] is None
    return model


@pytest.mark.parametrize("where", ["link", "model"])
def test_the_first_visitor_waits_for_the_small_file_where_the_whole_would_take_longer(
    service: Up, unmade: SmallModel, open_window: Open, where: str
) -> None:
    link = service.http.post(f"/v1/models/{unmade.id}/shares", json={"expires_in": "1h"}).json()["path"]
    visit = open_window(service)
    loaded = slowed(visit, SLOWER)
    asked = requests(visit.page)
    visit.page.goto(link if where == "link" else f"/models/{unmade.id}", wait_until="commit")
    visit.page.wait_for_function(DRAWN, polling=50, timeout=60_000)
    assert sum(loaded) < FIRST_FRAME
    assert [line.split()[0] for line in asked if line.endswith("/download/sog")] == ["HEAD", "GET"]
    assert not [line for line in asked if line.endswith("/model.ply")]


def test_nobody_waits_for_the_small_file_where_the_whole_is_there_sooner(
    service: Up, unmade: SmallModel, open_window: Open
) -> None:
    visit = open_window(service)
    page = visit.page
    page.route("**/download/sog", lambda route: None)  # it is never made
    asked = requests(page)
    page.goto(f"/models/{unmade.id}")
    page.wait_for_function(DRAWN, polling=50)
    assert [line.split()[0] for line in asked if line.endswith("/download/sog")] == ["HEAD"]
    assert [line for line in asked if line.endswith("/model.ply")]
    page.unroute_all(behavior="ignoreErrors")
