"""Cameras as other programs write them: names with spaces, several models, byte-order marks, other case, null frames.

Does not prove binary models; tests/worker/sfm/posed does.
"""

from __future__ import annotations

import codecs
import json
from pathlib import Path

import numpy as np
import pytest

from splatmill_worker.scene import Scene
from splatmill_worker.sfm import posed
from tests.inputs.conftest import Build
from tests.support.posed_sets import FLIP

pytestmark = pytest.mark.slow


def test_names_with_spaces_have_the_cameras_of_plain_ones(built: Build) -> None:
    folder = built("colmap-text-spaces")
    right = {view.name: view.camera.viewmat for view in loaded(built("posed-text-variants") / "bom").views}
    views = {view.name: view.camera.viewmat for view in loaded(folder).views}
    assert views.keys() == {f"my photo ({number}).jpg" for number in range(1, 31)}
    for number in range(1, 31):
        np.testing.assert_allclose(
            views[f"my photo ({number}).jpg"], right[f"still_{number:04d}.jpg"], atol=1e-9
        )


def test_the_larger_of_two_models_is_used_and_named(built: Build) -> None:
    scene = loaded(built("two-sparse"))
    assert len(scene.views) == 26
    (warning,) = scene.warnings
    assert "Of 2 COLMAP models, sparse/1 is used, with 26 photos" in warning
    assert "sparse/0 has 4 of the photos" in warning


def test_text_with_a_byte_order_mark_has_its_cameras(built: Build) -> None:
    folder = built("posed-text-variants") / "bom"
    text = (folder / "transforms.json").read_bytes()
    assert text.startswith(codecs.BOM_UTF8)
    poses = {Path(row["file_path"]).name: row["transform_matrix"] for row in json.loads(text[3:])["frames"]}
    views = {view.name: view.camera.viewmat for view in loaded(folder).views}
    assert views.keys() == poses.keys()
    for name, pose in poses.items():
        # The file has OpenGL's axes, and from the camera to the world.
        np.testing.assert_allclose(np.linalg.inv(views[name]), np.array(pose) @ FLIP, atol=1e-9)


@pytest.mark.parametrize(("kind", "count"), [("case", 30), ("images-2-4", 30), ("null-frame", 29)])
def test_other_variants_of_the_text_have_the_same_cameras(built: Build, kind: str, count: int) -> None:
    right = {view.name: view.camera for view in loaded(built("posed-text-variants") / "bom").views}
    scene = loaded(built("posed-text-variants") / kind)
    assert len(scene.views) == count
    for view in scene.views:
        camera = right[Path(view.name).name.lower()]
        size = view.camera.width / camera.width
        np.testing.assert_allclose(view.camera.viewmat, camera.viewmat, atol=1e-9)
        assert (view.camera.fx, view.camera.fy) == pytest.approx((size * camera.fx, size * camera.fy))
    if kind == "null-frame":
        assert any("1 of 30 in transforms.json" in text for text in (*scene.warnings, *scene.notes))


def loaded(folder: Path) -> Scene:
    poses = posed.find(folder)
    assert poses is not None
    return poses.load()
