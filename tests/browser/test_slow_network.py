"""What people see over a slow connection until the scene is drawn: first its picture, with words on what is loaded, and
then the scene itself, from few bytes.

Bytes are counted here and times are not. How long a file takes to make for the first visitor is not proved here.
"""

from __future__ import annotations

import io

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image
from playwright.sync_api import Locator, expect

from tests.browser.conftest import Open, SmallModel
from tests.support.up import Up
from tests.support.waiting import wait_for

SLOW = {"offline": False, "latency": 150, "downloadThroughput": 200_000, "uploadThroughput": 200_000}
"""1.6 Mbit/s and 150 ms, as a phone has at the edge of a cell."""

FIRST_FRAME = 600_000
"""Most bytes until the first full frame of the scene, which is of 3000 Gaussians."""

PICTURE = {"link": 60_000, "frame": 60_000, "model": 150_000}
"""Most bytes until the picture is seen. Links come with it; the model's page has to learn first what the model has."""


def inner(box: Locator) -> npt.NDArray[np.float64]:
    """The middle of a view as it is shown, without the words at its lower edge, RGB in 0 to 1."""
    with Image.open(io.BytesIO(box.screenshot())) as shown:
        pixels = np.asarray(shown.convert("RGB")) / 255.0
    height, width = pixels.shape[:2]
    side = int(0.6 * height)  # the picture is 4:3 and as high as the view
    return pixels[: int(0.85 * height), width // 2 - side : width // 2 + side]


@pytest.mark.parametrize("where", ["link", "frame", "model"])
def test_the_picture_comes_first_and_the_scene_from_few_bytes(
    service: Up, model: SmallModel, open_window: Open, where: str
) -> None:
    service.http.get(f"/v1/models/{model.id}/download/sog", timeout=60)
    link = service.http.post(f"/v1/models/{model.id}/shares", json={"expires_in": "1h"}).json()["path"]
    address = {"link": link, "frame": f"{link}/embed", "model": f"/models/{model.id}"}[where]
    box = "#viewer" if where == "model" else "#view"
    visit = open_window(service)
    page = visit.page
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    session, loaded = visit.context.new_cdp_session(page), [0]
    session.send("Network.enable")
    session.on("Network.dataReceived", lambda part: loaded.append(part["encodedDataLength"]))
    session.send("Network.emulateNetworkConditions", SLOW)
    page.goto(address, wait_until="commit")
    page.wait_for_function(f"() => document.querySelector('{box} img')?.naturalWidth > 0", polling=50)
    assert sum(loaded) < PICTURE[where], "the picture comes before the engine"
    poster = inner(page.locator(box))
    expect(page.locator(".view .said")).to_contain_text("Loading")
    page.wait_for_function(
        f"""() => Number(document.querySelector('{box} .view')?.dataset.frames) > 0
          && !document.querySelector('.view img')""",
        polling=50,
    )
    assert sum(loaded) < FIRST_FRAME
    expect(page.locator(".view .said")).to_be_empty()
    # A frame that was drawn is shown a moment later.
    wait_for(lambda: -10 * np.log10(np.square(inner(page.locator(box)) - poster).mean()) > 25)
    assert not [url for url in asked if url.endswith("/model.ply")]
