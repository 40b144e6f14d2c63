"""Panoramas with cameras are read, and those without are known. tests/worker/images/test_lens.py is of fisheyes."""

from __future__ import annotations

from pathlib import Path

import pytest

from splatmill_worker.images.panoramas import faces
from splatmill_worker.images.prepare import prepare
from splatmill_worker.sfm import posed
from tests.inputs.conftest import Build


@pytest.mark.slow
def test_panoramas_with_cameras_are_read(built: Build) -> None:
    poses = posed.find(built("equirectangular"))
    assert poses is not None
    scene = poses.load()
    assert all(faces.is_panorama(view) for view in scene.views)
    assert len(faces.cut(scene).views) == 6 * len(scene.views)


@pytest.mark.slow
def test_panoramas_without_cameras_are_known(built: Build, tmp_path: Path) -> None:
    prepared = prepare(built("equirectangular") / "images", None, tmp_path)
    assert all(photo.is_panorama for photo in prepared.photos)
    assert "taken for 360-degree panoramas" in prepared.warnings[0]
