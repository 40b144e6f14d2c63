"""A data set in one zip gives the scene that its folder gives: cameras, photos and masks in their roles. Cameras in a
zip among loose photos are found, or named.

Does not prove that unpacking is safe (tests/worker/images does), nor how each layout is read (test_posed.py).
"""

import json
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatmill.schema import TrainOptions
from splatmill.transfer.local_capture import find_files
from splatmill_worker.errors import Refusal
from splatmill_worker.images.archives.archive import Allowance
from splatmill_worker.pipeline.capture import posed_scene
from splatmill_worker.sfm import posed
from splatmill_worker.sfm.posed import zipped
from tests.support import posed_sets, still_life
from tests.support.files.program_files import PROGRAMS, SIZE
from tests.support.posed_sets import NAMES


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
    scene = scene_of(tmp_path / "capture", tmp_path / "work")
    assert scene.source == expected.source
    assert [view.name for view in scene.views] == [view.name for view in expected.views]
    assert [view.split for view in scene.views] == [view.split for view in expected.views]
    for one, other in zip(scene.views, expected.views, strict=True):
        np.testing.assert_array_equal(one.camera.viewmat, other.camera.viewmat)
        np.testing.assert_array_equal(one.camera.K, other.camera.K)
        assert one.mask is not None
        assert other.mask is not None
    np.testing.assert_array_equal(scene.points, expected.points)


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
    root = zipped.data_set(tmp_path / "capture", tmp_path / "work")
    assert (root / "masks").is_dir()
    assert (root / "images").is_dir()


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


def stored(source: Path, capture: Path) -> Path:
    """The capture that the command line makes of a folder."""
    for file in find_files(source).files:
        target = capture / file.role / file.name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(file.path.read_bytes())
    return capture


@pytest.mark.parametrize("program", PROGRAMS)
@pytest.mark.parametrize("sent", [True, False])
def test_cameras_in_a_zip_among_loose_photos_are_found(tmp_path: Path, program: str, sent: bool) -> None:
    """Of a folder by the command line, and of a capture in which photos and zip lie side by side."""
    source = tmp_path / "given/images"
    posed_sets.photos(source, size=SIZE)
    cameras = tmp_path / "cameras"
    (cameras / "scan").mkdir(parents=True)
    PROGRAMS[program].write(cameras / "scan", [posed_sets.viewmat(k) for k in range(posed_sets.COUNT)], NAMES)
    zip_of(cameras, source / "cams.zip")
    capture = stored(source, tmp_path / "capture") if sent else tmp_path / "given"
    poses = zipped.cameras_beside(capture, tmp_path / "work")
    assert poses is not None
    scene = poses.load()
    for view in scene.views:
        expected = posed_sets.viewmat(posed_sets.ALL[view.name])
        np.testing.assert_allclose(view.camera.viewmat, expected, atol=1e-6)
    assert (len(scene.views), scene.left_out) == (posed_sets.COUNT, ())
    assert "The cameras are those in cams.zip." in scene.notes
    assert not any("zip" in warning for warning in scene.warnings)


@pytest.mark.parametrize(
    "write", [posed_sets.model, lambda folder: posed_sets.transforms(folder / "transforms.json")]
)
def test_models_and_transforms_in_such_a_zip_are_found(
    tmp_path: Path, write: Callable[[Path], object]
) -> None:
    source = tmp_path / "given"
    posed_sets.photos(source)
    write(tmp_path / "cameras/a/0")
    zip_of(tmp_path / "cameras", source / "cams.zip")
    poses = zipped.cameras_beside(stored(source, tmp_path / "capture"), tmp_path / "work")
    assert poses is not None
    posed_sets.check(poses.load(), posed_sets.ALL)


def test_cameras_in_a_zip_with_photos_are_named(tmp_path: Path) -> None:
    images, inner = tmp_path / "capture/images", tmp_path / "inner"
    posed_sets.photos(images, size=SIZE)
    posed_sets.photos(inner, size=SIZE)
    PROGRAMS["VisualSFM"].write(inner, [posed_sets.viewmat(k) for k in range(posed_sets.COUNT)], NAMES)
    zip_of(inner, images / "set.zip")
    assert zipped.cameras_beside(tmp_path / "capture", tmp_path / "work") is None
    (said,) = zipped.unused_cameras(tmp_path / "capture", tmp_path / "work")
    assert said.startswith(
        "The cameras in set.zip are not used, such as scene.nvm: photos lie in the zip and"
    )
    assert said in find_files(images).remarks


def test_a_zip_beside_photos_with_cameras_is_named(tmp_path: Path) -> None:
    capture = tmp_path / "capture"
    posed_sets.photos(capture / "images")
    posed_sets.transforms(capture / "poses/transforms.json")
    posed_sets.model(tmp_path / "other/sparse/0")
    zip_of(tmp_path / "other", capture / "images/cams.zip")
    scene = posed_sets.loaded(capture)
    assert scene.warnings == ("Videos and zips are not used where photos have cameras: cams.zip.",)
    (capture / "poses/transforms.json").rename(capture / "images/transforms.json")
    remarks = find_files(capture / "images").remarks
    assert any(
        "The cameras in cams.zip are not used, such as sparse/0/cameras.txt: other cameras" in text
        for text in remarks
    )


def test_two_zips_of_cameras_are_refused(tmp_path: Path) -> None:
    posed_sets.photos(tmp_path / "capture/images")
    posed_sets.model(tmp_path / "other/sparse/0")
    for name in ("a.zip", "b.zip"):
        zip_of(tmp_path / "other", tmp_path / "capture/images" / name)
    with pytest.raises(posed.TwoFiles, match=r"Cameras are in a.zip and in b.zip"):
        zipped.cameras_beside(tmp_path / "capture", tmp_path / "work")
