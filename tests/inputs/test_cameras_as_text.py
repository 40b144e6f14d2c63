"""Cameras as other programs write them: names with spaces, several models, byte-order marks, other case, null frames.

Does not prove binary models; tests/worker/sfm/posed does.
"""

from __future__ import annotations

from pathlib import Path

import pytest

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
    found = posed.find(again)
    assert found is not None
    assert {view.name for view in found.load().views} == {path.name for path in (folder / "images").iterdir()}


def test_the_larger_of_two_models_is_used_and_named(built: Build) -> None:
    found = posed.find(built("two-sparse"))
    assert found is not None
    scene = found.load()
    assert len(scene.views) == 26
    (warning,) = scene.warnings
    assert "Of 2 COLMAP models, sparse/1 is used, with 26 photos" in warning
    assert "sparse/0 has 4 of the photos" in warning


@pytest.mark.parametrize("kind", ["bom", "case", "images-2-4"])
def test_variants_of_the_text_train_with_their_cameras(built: Build, trained: Train, kind: str) -> None:
    result = trained(built("posed-text-variants") / kind)
    assert result.report["facts"]["source"] == ("transforms" if kind == "bom" else "colmap")
    assert len(result.report["views"]) == 30
    assert result.psnr > PLAIN_WITH_CAMERAS - 0.5


def test_one_frame_without_a_pose_is_left_out_and_said(built: Build, trained: Train) -> None:
    result = trained(built("posed-text-variants") / "null-frame")
    assert len(result.report["views"]) == 29
    assert any("1 of 30 in transforms.json" in warning for warning in result.report["warnings"])
    assert result.psnr > PLAIN_WITH_CAMERAS - 0.5
