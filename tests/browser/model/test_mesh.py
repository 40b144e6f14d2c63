"""A mesh on the page of a model, in a real browser: made by its button, said in words, stopped, saved, and opened by
three.js, which shows it where it is and in its colours.

Not proved here: how true meshes are (`splatmill bench mesh`).
"""

from __future__ import annotations

import io
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, Page, Route, expect

from splatmill_worker.mesh import glb
from splatmill_worker.mesh.triangles import Mesh
from tests.browser.conftest import SmallModel
from tests.support.paths import ROOT
from tests.support.programs import npm_package
from tests.support.up import Up

WAIT = 120_000
"""Milliseconds to wait for a mesh, whose process takes some seconds of a core to begin with."""

INSTALLED = ROOT / "server/web/node_modules"
ADDRESS = "http://three.test"
PAGE = """<!doctype html><body style="margin:0;background:#fff"><script type="importmap">{"imports": {
  "three": "/three/build/three.module.js", "three/addons/": "/three/examples/jsm/"}}</script>"""

OPEN = """async (eye) => {
  const THREE = await import("three");
  const { GLTFLoader } = await import("three/addons/loaders/GLTFLoader.js");
  const { scene } = await new GLTFLoader().loadAsync("/mesh.glb");
  const bounds = new THREE.Box3().setFromObject(scene);
  const middle = bounds.getCenter(new THREE.Vector3());
  const size = bounds.getSize(new THREE.Vector3()).length();
  const renderer = new THREE.WebGLRenderer({ preserveDrawingBuffer: true });
  renderer.setSize(480, 360);
  document.body.append(renderer.domElement);
  const world = new THREE.Scene();
  world.background = new THREE.Color("white");
  world.add(scene);
  const camera = new THREE.PerspectiveCamera(40, 4 / 3, size / 100, size * 10);
  camera.position.set(...eye).multiplyScalar(size).add(middle);
  camera.lookAt(middle);
  renderer.render(world, camera);
  let triangles = 0, material, textured;
  scene.traverse((each) => {
    if (each.isMesh) [triangles, material] = [triangles + each.geometry.index.count / 3, each.material.type];
    if (each.isMesh) textured = each.material.map !== null;
  });
  return { triangles, material, textured, min: bounds.min.toArray(), max: bounds.max.toArray() };
}"""


def opened(
    browser: Browser, file: bytes, eye: tuple[float, float, float]
) -> tuple[dict[str, object], Image.Image]:
    """What three.js finds in a `.glb`, and its picture from a direction, over the size of the mesh."""
    npm_package("three")

    def answer(route: Route) -> None:
        name = route.request.url.removeprefix(f"{ADDRESS}/")
        if not name:
            route.fulfill(body=PAGE, content_type="text/html")
        elif name == "mesh.glb":
            route.fulfill(body=file, content_type="model/gltf-binary")
        else:
            route.fulfill(path=INSTALLED / name, content_type="text/javascript")

    page = browser.new_page()
    page.route("**/*", answer)
    page.goto(ADDRESS)
    facts = page.evaluate(OPEN, [*eye])
    picture = page.locator("canvas").screenshot()
    page.close()
    if folder := os.environ.get("SPLATMILL_SCREENSHOTS"):
        (Path(folder) / f"three-{facts['triangles']}.png").write_bytes(picture)
    return facts, Image.open(io.BytesIO(picture)).convert("RGB")


@pytest.mark.parametrize("textured", [False, True])
def test_three_js_shows_a_mesh_upright_in_its_colours(
    browser: Browser, tmp_path: Path, textured: bool
) -> None:
    # Two squares upright in the plane z = 1 of a world whose y points down: green above, red below.
    corners = np.array([[-1, -1, 1], [1, -1, 1], [1, 0, 1], [-1, 0, 1]], np.float32)
    vertices = np.concatenate([corners, corners + np.array([0, 1, 0], np.float32)])
    faces = np.array([[0, 2, 1], [0, 3, 2], [4, 6, 5], [4, 7, 6]], np.int32)
    colors = np.repeat(np.array([[30, 160, 60], [200, 40, 30]], np.uint8), 4, axis=0)
    mesh = Mesh(vertices, faces, colors)
    if textured:
        # The first square shows the upper half of the texture, whose first row is at 0, and the second the lower half.
        picture_of = np.repeat(colors[[0, 4]], 32 * 64, axis=0).reshape(64, 64, 3)
        uvs = np.array([[0, 0], [1, 0], [1, 0.45], [0, 0.45]], np.float32)
        mesh = Mesh(
            vertices, faces, None, np.concatenate([uvs, uvs + np.array([0, 0.55], np.float32)]), picture_of
        )
    glb.write(tmp_path / "mesh.glb", mesh, (0.0, 0.0, 0.0))
    facts, picture = opened(browser, (tmp_path / "mesh.glb").read_bytes(), (0.0, 0.0, 1.0))
    assert (facts["triangles"], facts["material"], facts["textured"]) == (4, "MeshBasicMaterial", textured)
    assert (facts["min"], facts["max"]) == ([-1, -1, -1], [1, 1, -1])
    for row, expected in ((150, (30, 160, 60)), (210, (200, 40, 30))):
        shown = picture.getpixel((240, row))
        assert isinstance(shown, tuple)
        assert max(abs(a - b) for a, b in zip(shown, expected, strict=True)) <= (4 if textured else 2)


def test_a_mesh_is_made_by_its_button_saved_and_opened(
    browser: Browser, page: Page, service: Up, model: SmallModel, tmp_path: Path
) -> None:
    page.goto(f"/models/{model.id}")
    section = page.locator("#mesh")
    section.get_by_label("Only what lies in the box").check()
    section.get_by_role("button", name="Make a mesh").click()
    expect(section.get_by_role("status")).to_contain_text("There is no box yet")
    section.get_by_label("Only what lies in the box").uncheck()
    section.get_by_label("Colours").select_option("2048")
    expect(section.get_by_label("Most triangles")).to_have_value("100000")
    with page.expect_request(f"**/v1/models/{model.id}/meshes") as asking:
        section.get_by_role("button", name="Make a mesh").click()
    assert asking.value.post_data_json == {"format": "glb", "faces": 100_000, "texture": 2048}
    expect(section.get_by_role("status")).to_contain_text("This takes some minutes")
    section.get_by_role("button", name="Stop").click()
    expect(section.get_by_role("status")).to_have_text("Stopped.")
    assert service.http.get(f"/v1/models/{model.id}/meshes").json()["meshes"] == []
    section.get_by_label("Colours").select_option("of the corners")
    section.get_by_role("button", name="Make a mesh").click()
    save = section.get_by_role("link", name="Save .glb")
    expect(save).to_be_visible(timeout=WAIT)
    expect(section.locator("[role=status]")).to_be_empty()
    if folder := os.environ.get("SPLATMILL_SCREENSHOTS"):
        section.screenshot(path=f"{folder}/mesh-section.png")
    with page.expect_download() as downloading:
        save.click()
    downloading.value.save_as(tmp_path / "mesh.glb")
    facts, picture = opened(browser, (tmp_path / "mesh.glb").read_bytes(), (0.6, 0.6, 0.6))
    (made,) = service.http.get(f"/v1/models/{model.id}/meshes").json()["meshes"]
    assert facts["triangles"] == made["facts"]["triangles"]
    pixels = np.asarray(picture).reshape(-1, 3)
    drawn = pixels[(pixels < 250).any(1)]
    assert len(drawn) > 0.02 * len(pixels)
    assert len(np.unique(drawn // 32, axis=0)) > 3, "a mesh without colours"
    section.get_by_role("button", name="Delete the mesh").click()
    expect(save).to_have_count(0)
