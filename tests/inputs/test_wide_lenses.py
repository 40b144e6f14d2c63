"""A fisheye of 180 degrees trains as a pinhole cut out of its middle does; panoramas are refused by name."""

from __future__ import annotations

from pathlib import Path

import pytest

from splatmill_worker.images.prepare import prepare
from splatmill_worker.sfm import posed
from tests.inputs.conftest import Build, Train

CROPPED = 28.1
"""Held-out PSNR in dB of photos of a pinhole of 100 degrees, after 600 steps."""


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_fisheye_of_180_degrees_trains_as_its_middle(built: Build, trained: Train) -> None:
    result = trained(built("wide-fisheye"), "--steps", "600")
    assert result.psnr > CROPPED - 0.5
    (warning,) = (each for each in result.report["warnings"] if "OPENCV_FISHEYE" in each)
    assert "100 by 84 degrees" in warning
    assert not any("light" in each for each in result.report["warnings"])


@pytest.mark.slow
def test_panoramas_with_cameras_are_refused_by_name(built: Build) -> None:
    given = posed.find(built("equirectangular"))
    assert given is not None
    with pytest.raises(posed.UnreadModel, match="the camera model is EQUIRECTANGULAR") as error:
        given.load()
    assert "faces of a cube" in error.value.advice


@pytest.mark.slow
def test_panoramas_without_cameras_are_questioned(built: Build, tmp_path: Path) -> None:
    (warning,) = prepare(built("equirectangular") / "images", None, tmp_path).warnings
    assert "360-degree panoramas" in warning
