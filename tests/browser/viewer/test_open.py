"""A model file of the visitor's own is shown without being sent, and what is none is refused by name."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page, Route, expect

from tests.browser.conftest import SmallModel
from tests.support.up import Up

WAIT = 60_000
DROP = """([name, text]) => {
    const data = new DataTransfer();
    data.items.add(new File([text], name));
    document.body.dispatchEvent(new DragEvent("drop", { dataTransfer: data, bubbles: true, cancelable: true }));
}"""


@pytest.mark.parametrize("suffix", ["ply", "sog"])
def test_a_file_is_shown_and_not_sent(
    service: Up, model: SmallModel, page: Page, tmp_path: Path, suffix: str
) -> None:
    path = tmp_path / f"mine.{suffix}"
    path.write_bytes(service.http.get(f"/v1/models/{model.id}/download/{suffix}", timeout=60).content)
    sent: list[str] = []
    page.on("request", lambda request: sent.append(request.method) if "/v1/" in request.url else None)
    page.goto("/models")
    page.get_by_role("link", name="Open a file").click()
    page.get_by_label("Choose a file").set_input_files(path)
    expect(page.get_by_role("heading", level=1)).to_have_text(path.name, timeout=WAIT)
    expect(page.locator("#figures")).to_contain_text("shown from this device")
    page.wait_for_function("() => document.querySelector('.view .said').textContent === ''", timeout=WAIT)
    shown = page.locator("#view").screenshot()
    assert len(set(np.frombuffer(shown, np.uint8))) > 200
    page.set_viewport_size({"width": 390, "height": 800})
    expect(page.locator(".view")).to_be_visible()
    assert set(sent) <= {"GET"}


def test_what_is_no_model_is_refused_by_name_and_the_next_file_is_shown(
    service: Up, model: SmallModel, page: Page, tmp_path: Path
) -> None:
    page.goto("/open")
    for name, text, said in (
        ("notes.txt", "hello", r"notes\.txt: .*begins with the bytes 68 65 6c 6c"),
        ("empty.ply", "", r"empty\.ply: .*empty"),
        ("cut.ply", "ply\nformat binary_little_endian 1.0\nelement vertex 5\n", r"cut\.ply: "),
        ("<b>x</b>.spz", "NGSP", r"<b>x</b>\.spz: .*format \.spz"),
    ):
        page.evaluate(DROP, [name, text])
        expect(page.get_by_role("alert")).to_have_text(re.compile(said), timeout=WAIT)
    path = tmp_path / "good.ply"
    path.write_bytes(service.http.get(f"/v1/models/{model.id}/files/model.ply").content)
    page.get_by_label("Choose a file").set_input_files(path)
    expect(page.get_by_role("heading", level=1)).to_have_text("good.ply", timeout=WAIT)
    expect(page.get_by_role("alert")).to_have_count(0)


def test_a_file_that_is_dropped_before_the_page_knows_who_looks_is_taken(service: Up, page: Page) -> None:
    held: list[Route] = []
    page.route("**/v1/me", lambda route: held.append(route))
    page.goto("/open")
    page.evaluate(DROP, ["notes.txt", "hello"])
    expect(page.get_by_role("alert")).to_have_text(re.compile(r"notes\.txt: .*68 65 6c 6c"), timeout=WAIT)
    assert held
    held[0].continue_()
