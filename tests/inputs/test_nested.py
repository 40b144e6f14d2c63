"""A data set that lies one folder deeper than expected has its own cameras, as a folder, in a zip and uploaded.

A zip is read by the worker alone. Does not prove what a training makes of them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatmill.schema import Role
from splatmill.transfer.local_capture import find_files
from splatmill_worker.scene import Scene
from splatmill_worker.sfm import posed
from splatmill_worker.sfm.posed import zipped
from tests.inputs.conftest import Build
from tests.support.posed_sets import zip_of

pytestmark = pytest.mark.slow


def test_the_folder_a_zip_and_an_upload_of_it_have_its_cameras(built: Build, tmp_path: Path) -> None:
    folder = built("nested-data-set")
    expected = cameras(load(folder / "scene"))
    assert len(expected) == 30
    assert cameras(load(folder)) == expected
    zip_of(folder, tmp_path / "zip/images/scene.zip")
    assert cameras(load(zipped.data_set(tmp_path / "zip", tmp_path / "work"))) == expected
    for file in find_files(folder).files:
        stored = tmp_path / "upload" / file.role / file.name
        stored.parent.mkdir(parents=True, exist_ok=True)
        stored.symlink_to(file.path)
    assert set(Role) - {Role.masks} == {Role(path.name) for path in (tmp_path / "upload").iterdir()}
    assert cameras(load(tmp_path / "upload")) == expected


def load(capture: Path) -> Scene:
    poses = posed.find(capture)
    assert poses is not None
    return poses.load()


def cameras(scene: Scene) -> dict[str, list[float]]:
    return {
        view.name: np.round([*view.camera.viewmat.ravel(), *view.camera.K.ravel()], 9).tolist()
        for view in scene.views
    }
