"""Photos that EXIF turns upside down, with cameras of the upright pixels, train as upright ones do."""

from __future__ import annotations

import pytest

from tests.inputs.conftest import PLAIN_WITH_CAMERAS, Build, Train


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_photos_upside_down_train_with_cameras_of_upright_ones(built: Build, trained: Train) -> None:
    result = trained(built("orientation-180"))
    assert result.psnr > PLAIN_WITH_CAMERAS - 0.5
    (warning,) = (each for each in result.report["warnings"] if "EXIF orientation" in each)
    assert "15 photos" in warning
    assert "so the photos are read as their EXIF orientation turns them" in warning
