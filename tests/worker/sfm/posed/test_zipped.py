"""A data set in one zip gives the scene that its folder gives: cameras, photos and masks in their roles.

Does not prove that unpacking is safe (tests/worker/images does), nor how each layout is read (test_posed.py).
"""

import json
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatmill.schema import TrainOptions
from splatmill_worker.errors import Refusal
from splatmill_worker.images.archives.archive import Allowance
from splatmill_worker.pipeline.capture import posed_scene
from splatmill_worker.sfm.posed import zipped
from tests.support import still_life


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A data set as tools write it: images/, masks/ and transforms.json."""
    capture = still_life.posed_capture(tmp_path / "given")
    whole = tmp_path / "set"
    shutil.copytree(capture, whole)
    for path in list((whole / "poses").glob("*")) if (whole / "poses").is_dir() else []:
        shutil.move(path, whole / path.name)
    for photo in sorted((whole / "images").rglob("*.*")):
        with Image.open(photo) as image:
            mask = Image.new("L", image.size, 255)
        (whole / "masks").mkdir(exist_ok=True)
        mask.save(whole / "masks" / f"{photo.name}.png")
    return whole


def zip_of(folder: Path, target: Path, top: str = "") -> Path:
    target.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(target, "w") as archive:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                archive.write(path, f"{top}{path.relative_to(folder).as_posix()}")
    return target


def scene_of(capture: Path, work: Path):
    options = TrainOptions.model_validate({"steps": 10})
    return posed_scene(capture, work, options, lambda *_: None, lambda: False)


@pytest.mark.parametrize("top", ["", "my set/", "a/b/"])
def test_a_zip_gives_the_scene_of_its_folder(folder: Path, tmp_path: Path, top: str) -> None:
    zip_of(folder, tmp_path / "capture" / "images" / "set.zip", top)
    expected = scene_of(folder, tmp_path / "plain")
    found = scene_of(tmp_path / "capture", tmp_path / "work")
    assert found.source == expected.source
    assert [view.name for view in found.views] == [view.name for view in expected.views]
    assert [view.split for view in found.views] == [view.split for view in expected.views]
    for one, other in zip(found.views, expected.views, strict=True):
        np.testing.assert_array_equal(one.camera.viewmat, other.camera.viewmat)
        np.testing.assert_array_equal(one.camera.K, other.camera.K)
        assert one.mask is not None
        assert other.mask is not None
    np.testing.assert_array_equal(found.points, expected.points)


def test_a_zip_is_unpacked_once(folder: Path, tmp_path: Path) -> None:
    zip_of(folder, tmp_path / "capture" / "images" / "set.zip")
    first = zipped.data_set(tmp_path / "capture", tmp_path / "work")
    before = first.stat().st_mtime_ns
    assert zipped.data_set(tmp_path / "capture", tmp_path / "work") == first
    assert first.stat().st_mtime_ns == before
    assert len(list((tmp_path / "work" / "unpacked").iterdir())) == 1


def test_masks_without_cameras_keep_their_role(folder: Path, tmp_path: Path) -> None:
    for path in folder.glob("*.json"):
        path.unlink()
    shutil.rmtree(folder / "sparse", ignore_errors=True)
    zip_of(folder, tmp_path / "capture" / "images" / "set.zip")
    found = zipped.data_set(tmp_path / "capture", tmp_path / "work")
    assert (found / "masks").is_dir()
    assert (found / "images").is_dir()


def test_other_captures_are_read_as_they_are(folder: Path, tmp_path: Path) -> None:
    capture = tmp_path / "capture"
    work = tmp_path / "work"
    photos = tmp_path / "photos"
    shutil.copytree(folder / "images", photos)
    archive = zip_of(photos, capture / "images" / "photos.zip")
    assert zipped.data_set(capture, work) == capture  # photos alone
    archive.write_bytes(b"not a zip")
    assert zipped.data_set(capture, work) == capture  # `prepare` names the reason
    zip_of(folder, archive)
    (capture / "poses").mkdir()
    (capture / "poses" / "start.ply").write_bytes(b"ply")
    assert zipped.data_set(capture, work) != capture  # a model to start from is no pose
    (capture / "poses" / "transforms.json").write_text(json.dumps({"frames": []}))
    assert zipped.data_set(capture, work) == capture  # cameras were given besides the zip
    (capture / "poses" / "transforms.json").unlink()
    shutil.copy(next(photos.iterdir()), capture / "images" / "more.jpg")
    assert zipped.data_set(capture, work) == capture
    assert zipped.data_set(folder, work) == folder


def test_a_zip_that_unpacks_to_too_much_is_refused(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    zip_of(folder, tmp_path / "capture" / "images" / "set.zip")
    monkeypatch.setattr(zipped, "Allowance", lambda: Allowance(files=3))
    with pytest.raises(Refusal) as refused:
        zipped.data_set(tmp_path / "capture", tmp_path / "work")
    assert refused.value.code == "archive_bomb"
