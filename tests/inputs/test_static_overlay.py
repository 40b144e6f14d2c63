"""A logo at the same place of all photos is masked, and cameras and training are those of photos without one."""

from __future__ import annotations

import pytest

from tests.inputs.conftest import PLAIN_WITHOUT_CAMERAS, Build, Train


@pytest.mark.slow
def test_a_logo_is_masked_and_shown(built: Build, trained: Train) -> None:
    result = trained(built("static-overlay"))
    assert any("at the bottom left, never changes in 30 photos" in text for text in result.report["warnings"])
    assert "What never moves, and is masked" in (result.folder / "report.html").read_text("utf-8")
    assert result.report["sfm"]["registered"] == 30
    assert abs(result.psnr - PLAIN_WITHOUT_CAMERAS) < 0.3
