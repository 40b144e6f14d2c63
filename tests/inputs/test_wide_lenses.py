"""Panoramas are refused by name. Of a fisheye, tests/worker/images/test_lens.py proves the middle that is used."""

from __future__ import annotations

from pathlib import Path

import pytest

from splatmill_worker.images.prepare import prepare
from splatmill_worker.sfm import posed
from tests.inputs.conftest import Build


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
