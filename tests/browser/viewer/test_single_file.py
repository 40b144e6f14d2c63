"""The model with its viewer in one HTML file, opened from the disk in a real browser without network: it draws what our
renderer draws, and asks for nothing.

Does not prove the address that hands it out (tests/server/background/test_conversions.py).
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from playwright.sync_api import Browser

from splatmill.schema import Annotation, CameraSpec, ModelCamera, ModelCameras, Presentation
from splatmill_server.responses.single_file import single_file
from splatmill_worker.render_service.encoding import camera_of
from splatmill_worker.splat.formats import ply, registry
from splatmill_worker.splat.render import render
from tests.support.ball import write_ply
from tests.support.programs import npm_package

EYES = ((4.0, 1.0, -1.0), (0.5, -4.0, 1.0), (-3.0, 0.5, 2.0))

FLOOR = 34.0
"""PSNR in dB of the file's picture against our renderer's, as in test_viewer."""


@pytest.mark.parametrize("levels", [False, True], ids=["sog", "lod.zip"])
def test_the_file_draws_the_model_and_asks_for_nothing(
    browser: Browser, tmp_path: Path, levels: bool
) -> None:
    npm_package("playcanvas")  # it is in the file
    write_ply(tmp_path / "model.ply", 800)
    scene = ply.read(tmp_path / "model.ply").gaussians
    specs = [CameraSpec.looking_at(eye, (0, 0, 0), width=480, height=360) for eye in EYES]
    cameras = ModelCameras(
        cameras=[ModelCamera(name=f"</script>{i}", camera=spec) for i, spec in enumerate(specs)]
    )
    name = 'A ball </title><script>throw "no"</script>'
    packed = tmp_path / ("model.lod.zip" if levels else "model.sog")
    registry.write(packed, scene)
    shown_as = Presentation(
        start_view=CameraSpec.looking_at((1, -4, 0.5), (0, 0, 0), width=480, height=360),
        annotations=[Annotation(point=(0, -1, 0), text="</script>the top")],
    )
    made = single_file(
        name, packed.read_bytes(), cameras, antialias=False, presentation=shown_as, levels=levels
    )
    (tmp_path / "model.html").write_bytes(made)
    context = browser.new_context(viewport={"width": 480, "height": 360}, offline=True)
    try:
        page, asked, said = context.new_page(), [], []
        page.on("request", lambda request: asked.append(request.url))
        page.on("console", lambda message: said.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: said.append(str(error)))
        page.goto((tmp_path / "model.html").as_uri())
        # A function, because the policy of the page forbids the evaluation of text.
        page.wait_for_function(
            "() => globalThis.view?.frames > 0 || /cannot/.test(said.textContent)", polling=200
        )
        assert page.locator("#said").text_content() == ""
        assert page.title() == name
        assert page.evaluate("[view.kind, view.gaussians]") == ["webgl", 800]
        assert page.evaluate("getComputedStyle(view.element).touchAction") == "none", (
            "there is no page to scroll"
        )
        page.evaluate("globalThis.before = -1")
        page.wait_for_function(
            "() => { const same = view.frames === before; globalThis.before = view.frames; return same; }",
            polling=300,
        )
        assert page.evaluate("view.pose.position") == [1, -4, 0.5], "it begins with the start view"
        page.get_by_role("button", name="Annotation 1").click()
        assert page.locator(".pin-text").text_content() == "</script>the top"
        point = page.evaluate("view.pointAt(240, 180)")  # of what is drawn, since there is no server
        assert abs(np.linalg.norm(point) - 1) < 0.15, "it lies on the unit ball"
        page.evaluate("document.querySelectorAll('.view-bar, .said, .pins').forEach((each) => each.remove())")
        spec = CameraSpec.model_validate(page.evaluate("view.getCamera()"))
        with Image.open(io.BytesIO(page.locator("#view").screenshot())) as picture:
            shown = np.asarray(picture.convert("RGB")) / 255.0
        assert not said
        assert [url for url in asked if not url.startswith(("file:", "data:", "blob:"))] == []
    finally:
        context.close()
    with torch.no_grad():
        reference = render(scene, camera_of(spec), background=(0, 0, 0)).color.clamp(0, 1).numpy()
    assert reference.std() > 0.1
    assert -10 * np.log10(np.square(shown - reference).mean()) > FLOOR
