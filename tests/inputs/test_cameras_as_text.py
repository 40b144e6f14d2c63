"""Cameras as other programs write them: names with spaces, several models, byte-order marks, other case, null frames.

Does not prove binary models; tests/worker/sfm/posed does.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatmill_worker.scene import Scene
from splatmill_worker.sfm import posed
from tests.inputs.conftest import PLAIN_WITH_CAMERAS, Build, Train
from tests.support.command_line import spawn

pytestmark = pytest.mark.slow


def test_names_with_spaces_are_read_and_written_again(built: Build, trained: Train, tmp_path: Path) -> None:
    folder = built("colmap-text-spaces")
    # The photos that are held out of the plain still life: its names sort in the order of their numbers.
    held_out = [
        option for number in range(1, 31, 8) for option in ("--test-views", f"my photo ({number}).jpg")
    ]
    result = trained(folder, *held_out)
    assert result.report["facts"]["source"] == "colmap"
    assert result.psnr > PLAIN_WITH_CAMERAS - 0.5
    again = tmp_path / "again"
    said, warned = spawn("cameras", result.folder, "-o", again, "--format", "colmap-text").communicate(
        timeout=120
    )
    assert str(again / "sparse/0/images.txt") in said
    assert "names with spaces (30)" in warned
    (again / "images").symlink_to(folder / "images")
    assert {view.name for view in loaded(again).views} == {
        path.name for path in (folder / "images").iterdir()
    }


def test_the_larger_of_two_models_is_used_and_named(built: Build) -> None:
    scene = loaded(built("two-sparse"))
    assert len(scene.views) == 26
    (warning,) = scene.warnings
    assert "Of 2 COLMAP models, sparse/1 is used, with 26 photos" in warning
    assert "sparse/0 has 4 of the photos" in warning


def test_text_with_a_byte_order_mark_trains_with_its_cameras(built: Build, trained: Train) -> None:
    result = trained(built("posed-text-variants") / "bom")
    assert result.report["facts"]["source"] == "transforms"
    assert len(result.report["views"]) == 30
    assert result.psnr > PLAIN_WITH_CAMERAS - 0.5


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
    found = posed.find(folder)
    assert found is not None
    return found.load()
