"""A data set that lies one folder deeper than expected trains with its own cameras, as a folder, in a zip and uploaded.

A zip is read by the worker alone. Its photos and cameras are compared with those of the folder, and not trained.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatmill.local_capture import find_files
from splatmill.schema import Role
from splatmill_worker.scene import Scene
from splatmill_worker.sfm import posed
from splatmill_worker.sfm.posed import zipped
from tests.inputs.conftest import PLAIN_WITH_CAMERAS, Build, Train
from tests.support.posed_sets import zip_of

pytestmark = pytest.mark.slow


def test_a_data_set_one_folder_down_trains_with_its_cameras(built: Build, trained: Train) -> None:
    result = trained(built("nested-data-set"))
    assert result.report["facts"]["source"] == "colmap"
    assert result.psnr > PLAIN_WITH_CAMERAS - 0.5


def test_a_zip_and_an_upload_of_it_have_the_cameras_of_the_folder(built: Build, tmp_path: Path) -> None:
    folder = built("nested-data-set")
    expected = cameras(load(folder / "scene"))
    assert len(expected) == 30
    zip_of(folder, tmp_path / "zip/images/scene.zip")
    assert cameras(load(zipped.data_set(tmp_path / "zip", tmp_path / "work"))) == expected
    for file in find_files(folder).files:
        stored = tmp_path / "upload" / file.role / file.name
        stored.parent.mkdir(parents=True, exist_ok=True)
        stored.symlink_to(file.path)
    assert set(Role) - {Role.masks} == {Role(path.name) for path in (tmp_path / "upload").iterdir()}
    assert cameras(load(tmp_path / "upload")) == expected


def load(capture: Path) -> Scene:
    found = posed.find(capture)
    assert found is not None
    return found.load()


def cameras(scene: Scene) -> dict[str, list[float]]:
    return {
        view.name: np.round([*view.camera.viewmat.ravel(), *view.camera.K.ravel()], 9).tolist()
        for view in scene.views
    }
