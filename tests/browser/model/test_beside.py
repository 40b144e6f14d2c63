"""Two models side by side: they are chosen in the list, one camera sees both where they share their coordinates, and
each photo that neither has seen stands with the dB of both.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from playwright.sync_api import Page, expect

from tests.browser.conftest import SmallModel
from tests.support.up import Up
from tests.support.waiting import wait_for

WAIT = 60_000


@pytest.fixture
def other(service: Up, model: SmallModel) -> Iterator[str]:
    """A model made from the small one, in its coordinates."""
    address, edit = f"/v1/models/{model.id}/edits", {"min_opacity": 0.3}
    # The renderer of a service that has just been started may not answer yet.
    answer = wait_for(
        lambda: (a := service.http.post(address, json=edit, timeout=120)).status_code != 503 and a
    )
    assert answer.is_success, answer.text
    made = answer.json()["model"]
    service.http.patch(f"/v1/models/{made}", json={"name": "cleaned"}).raise_for_status()
    yield str(made)
    service.http.delete(f"/v1/jobs/{made}").raise_for_status()


DRAWN = "[...document.querySelectorAll('#pair .view')].map((view) => Number(view.dataset.frames) > 1)"
"""Whether each view was drawn again after its Gaussians were sorted."""

POSES = "[...document.querySelectorAll('#pair .view')].map((view) => view.dataset.frames)"


def test_one_camera_sees_two_models_that_share_their_coordinates(
    service: Up, model: SmallModel, other: str, page: Page
) -> None:
    page.goto("/models")
    compare = page.get_by_role("button", name="Compare", exact=True)
    expect(compare).to_be_hidden()
    page.get_by_role("button", name="Select", exact=True).click()
    page.get_by_role("checkbox", name="Select cleaned").check()
    expect(compare).to_be_disabled()
    page.get_by_role("checkbox", name="Select still life").check()
    compare.click()
    page.locator("html[data-ready]").wait_for(timeout=WAIT)
    expect(page.locator("#said")).to_contain_text("one camera")
    figures = page.locator("#pair figcaption")
    for id in (other, model.id):
        record = service.http.get(f"/v1/models/{id}").json()
        expect(figures.filter(has=page.locator(f'a[href="/models/{id}"]'))).to_contain_text(
            f"{record['psnr']:.1f} dB"
        )
    cameras = {
        id: {
            camera["name"]: camera
            for camera in service.http.get(f"/v1/models/{id}/cameras").json()["cameras"]
        }
        for id in (other, model.id)
    }
    name = next(name for name, camera in cameras[model.id].items() if camera["split"] == "test")
    row = page.get_by_role("row").filter(has_text=name)
    for column, id in enumerate((other, model.id), 1):
        expect(row.get_by_role("cell").nth(column)).to_contain_text(f"{cameras[id][name]['psnr']:.1f}")

    # Both are drawn, in place of the pictures that stand for them until then.
    expect(page.locator("#pair .view img")).to_have_count(0, timeout=WAIT)
    assert page.evaluate(DRAWN) == [True, True]

    # A model of which the other one moves: both draw anew, and both show the same camera.
    before = page.evaluate(POSES)
    page.locator("#pair .view").nth(1).focus()
    page.keyboard.press("ArrowLeft")
    page.wait_for_function(
        f"(before) => {POSES}.every((frames, i) => frames !== before[i])", arg=before, timeout=WAIT
    )
    page.set_viewport_size({"width": 390, "height": 780})
    assert page.evaluate("document.documentElement.scrollWidth") <= 390


def test_coordinates_are_the_same_only_where_the_photos_are(page: Page) -> None:
    page.goto("/compare")
    expect(page.get_by_role("alert")).to_contain_text("Choose two models in the list")
    script = """async () => {
      const { sameWorld } = await import("/page/any/beside/same_world.js");
      const at = (name, x) => ({ name, camera: { camera_to_world: [[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0]] } });
      const own = [at("a", 0), at("b", 4)];
      return [own, [at("a", 0.03), at("b", 4)], [at("a", 0.1), at("b", 4)], [at("a", 0)], [at("c", 0), at("d", 4)], []]
        .map((other) => sameWorld(own, other));
    }"""
    assert page.evaluate(script) == [True, True, False, False, False, False]
