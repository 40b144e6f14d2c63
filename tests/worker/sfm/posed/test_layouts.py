"""A data set some folders down, in a zip, or with several COLMAP models has the cameras that the plain one has.

Does not prove that the names and the text of other programs are read (test_variants.py does).
"""

import json
import zipfile
from pathlib import Path

import pytest

from splatmill.data_sets import TwoDataSets
from splatmill.schema import TrainOptions
from splatmill.transfer.local_capture import find_files
from splatmill_worker.errors import Refusal
from splatmill_worker.images.archives.archive import UnsafeArchive, unpack
from splatmill_worker.pipeline.capture import posed_scene
from splatmill_worker.sfm import posed
from splatmill_worker.sfm.posed import zipped
from tests.support.posed_sets import (
    ALL,
    COUNT,
    NAMES,
    check,
    frames,
    loaded,
    model,
    photos,
    transforms,
    zip_of,
)


@pytest.mark.parametrize("top", ["scene", "my scene/export", "a/b/c/d", "dense/0"])
@pytest.mark.parametrize("kind", ["colmap", "transforms"])
def test_a_data_set_some_folders_down_is_read(tmp_path: Path, top: str, kind: str) -> None:
    photos(tmp_path / top / "images")
    if kind == "colmap":
        model(tmp_path / top / "sparse/0")
    else:
        transforms(tmp_path / top / "transforms.json")
    (tmp_path / "readme.txt").write_text("by another program")
    check(loaded(tmp_path), ALL)


@pytest.mark.parametrize("slash", ["/", "\\"])
def test_a_zip_with_more_than_the_data_set_is_read(tmp_path: Path, slash: str) -> None:
    photos(tmp_path / "set/scene/images")
    model(tmp_path / "set/scene/sparse/0")
    (tmp_path / "set/license.txt").write_text("free")
    photos(tmp_path / "set", ["cover.jpg"])
    zip_of(tmp_path / "set", tmp_path / "capture/images/set.zip", slash)
    scene = loaded(zipped.data_set(tmp_path / "capture", tmp_path / "work"))
    check(scene, ALL)
    (warning,) = scene.warnings
    assert "not used: 1, such as cover.jpg" in warning


def test_backslashes_lead_out_of_no_zip(tmp_path: Path) -> None:
    (tmp_path / "a.zip").parent.mkdir(exist_ok=True)
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        entry = zipfile.ZipInfo("x")
        entry.filename = "..\\out.jpg"
        archive.writestr(entry, b"x")
    with pytest.raises(UnsafeArchive, match="outside"):
        unpack(tmp_path / "a.zip", tmp_path / "there")


def test_cameras_beside_the_folder_of_their_photos_are_read(tmp_path: Path) -> None:
    photos(tmp_path / "photos")
    model(tmp_path / "export/sparse/0")
    check(loaded(tmp_path), {f"photos/{name}": k for name, k in ALL.items()})


def test_two_data_sets_are_refused_with_both_named(tmp_path: Path) -> None:
    for scene in ("chair", "table"):
        photos(tmp_path / "set" / scene / "images")
        model(tmp_path / "set" / scene / "sparse/0")
    with pytest.raises(TwoDataSets, match="chair/ and in table/"):
        posed.find(tmp_path / "set")
    zip_of(tmp_path / "set", tmp_path / "capture/images/set.zip")
    with pytest.raises(Refusal, match="chair/ and in table/"):
        posed_scene(tmp_path / "capture", tmp_path / "work", TrainOptions(), lambda *_: None, lambda: False)


@pytest.mark.parametrize(
    "place", ["sparse/{}", "colmap/sparse/{}", "{}", "poses/sparse/{}", "scene/sparse/{}"]
)
@pytest.mark.parametrize("larger", [0, 1])
def test_the_model_with_most_photos_is_used_and_the_others_named(
    tmp_path: Path, place: str, larger: int
) -> None:
    photos(tmp_path / ("scene/images" if place.startswith("scene") else "images"))
    model(tmp_path / place.format(1 - larger), dict(enumerate(NAMES[:3])))
    model(tmp_path / place.format(larger), {k: NAMES[k] for k in range(3, COUNT)})
    scene = loaded(tmp_path)
    check(scene, {NAMES[k]: k for k in range(3, COUNT)})
    (warning,) = scene.warnings
    assert f"{larger} is used, with 9 photos" in warning
    assert f"{1 - larger} has 3 of the photos" in warning


def test_photos_that_the_capture_lacks_do_not_count(tmp_path: Path) -> None:
    photos(tmp_path / "images", NAMES[:3])
    model(tmp_path / "sparse/0", {k: NAMES[k] for k in range(2, COUNT)})
    model(tmp_path / "sparse/1", dict(enumerate(NAMES[:3])))
    check(loaded(tmp_path), {NAMES[k]: k for k in range(3)})


def test_a_broken_model_among_several_is_named(tmp_path: Path) -> None:
    photos(tmp_path / "images")
    model(tmp_path / "sparse/0", change=lambda _: b"\x01\x02")
    model(tmp_path / "sparse/1")
    scene = loaded(tmp_path)
    check(scene, ALL)
    assert "sparse/0 is not used: cameras.txt could not be read" in scene.warnings[0].replace(
        "The COLMAP model in sparse/0 could not be read: ", ""
    )


# The raw data of Polycam: a file with the camera of each photo.


def polycam(folder: Path, kind: str = "corrected_", change: dict[int, object] | None = None) -> None:
    """Cameras whose world is that of `viewmat`, with its x, y and z as the z, x and y of Polycam."""
    cameras, images = folder / f"keyframes/{kind}cameras", folder / f"keyframes/{kind}images"
    cameras.mkdir(parents=True)
    photos(images, [f"{1700 + k}.jpg" for k in range(COUNT)])
    for k, frame in enumerate(frames()):
        x, y, z, _ = frame["transform_matrix"]
        elements = {f"t_{i}{j}": row[j] for i, row in enumerate((y, z, x)) for j in range(4)}
        camera: object = elements | {"fx": 60, "fy": 61, "cx": 32, "cy": 24, "width": 64, "height": 48}
        (cameras / f"{1700 + k}.json").write_text(json.dumps((change or {}).get(k, camera)))
    (folder / "mesh_info.json").write_text('{"alignmentTransform": []}')


@pytest.mark.parametrize("kind", ["corrected_", ""])
@pytest.mark.parametrize("form", ["folder", "scene/", "zip", "upload"])
def test_the_raw_data_of_polycam_are_read(tmp_path: Path, kind: str, form: str) -> None:
    polycam(tmp_path / "made" / ("scene" if form == "scene/" else ""), kind)
    capture = tmp_path / "made"
    if form == "zip":
        zip_of(capture, tmp_path / "zip/images/raw.zip")
        capture = zipped.data_set(tmp_path / "zip", tmp_path / "work")
    elif form == "upload":
        for file in find_files(tmp_path / "made").files:
            stored = tmp_path / "upload" / file.role / file.name
            stored.parent.mkdir(parents=True, exist_ok=True)
            stored.write_bytes(file.path.read_bytes())
        capture = tmp_path / "upload"
    scene = loaded(capture)
    check(scene, {f"keyframes/{kind}images/{1700 + k}.jpg": k for k in range(COUNT)})
    assert scene.views[0].camera.fy == 61
    assert scene.warnings == ()


def test_corrected_cameras_of_polycam_come_first(tmp_path: Path) -> None:
    polycam(tmp_path)
    polycam(tmp_path, "", {k: {} for k in range(COUNT)})
    check(loaded(tmp_path), {f"keyframes/corrected_images/{1700 + k}.jpg": k for k in range(COUNT)})


def test_corrected_cameras_need_the_photos_they_are_of(tmp_path: Path) -> None:
    polycam(tmp_path)
    (tmp_path / "keyframes/corrected_images").rename(tmp_path / "keyframes/images")
    with pytest.raises(ValueError, match="photos in keyframes/corrected_images, which is missing"):
        loaded(tmp_path)


def test_a_photo_of_polycam_without_a_pose_is_left_out(tmp_path: Path) -> None:
    polycam(tmp_path, change={3: {"fx": 60}, 4: None})
    scene = loaded(tmp_path)
    assert len(scene.views) == COUNT - 2
    assert any("2 of 12 in corrected_cameras" in warning for warning in scene.warnings)
