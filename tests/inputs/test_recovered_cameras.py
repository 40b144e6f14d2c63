"""Photos without EXIF of two phones and of a level circle give the true lenses.

Does not prove the rotations of the cameras; the held-out photos of the two phones depend on them.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from splatmill_worker import sfm
from tests.inputs.conftest import Build, Train

pytestmark = pytest.mark.slow

TWO_PHONES = 22.9
"""Held-out PSNR in dB of the photos of two phones when EXIF gives their focal lengths."""


def test_two_phones_without_exif_end_where_exif_leads(built: Build, trained: Train) -> None:
    result = trained(built("two-cameras-one-lens"))
    assert result.psnr > TWO_PHONES - 0.5
    assert len(result.report["views"]) == 30


def test_a_level_circle_has_the_focal_length_of_its_lens(built: Build, tmp_path: Path) -> None:
    options = sfm.SfmOptions(stereo=False)
    scene = sfm.reconstruct(built("level-circle"), None, tmp_path, options, lambda *_: None, lambda: False)
    assert len(scene.views) == 45
    for view in scene.views:
        assert view.camera.fx == view.camera.fy == pytest.approx(315, rel=0.02)
    assert any("assumed to be square" in note for note in scene.notes)
