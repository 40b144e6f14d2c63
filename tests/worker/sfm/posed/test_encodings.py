"""Proves that names in files of cameras in the encoding of a system are matched to the photos, in COLMAP models and in
transforms.json, and that two readings which lead to different photos are refused with both named.

Not proven here: names in a zip (images/test_archive.py).
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from splatmill.schema.files.names import storable_name
from splatmill_worker.colmap import pycolmap
from splatmill_worker.readers import colmap_files
from splatmill_worker.sfm.posed.encodings import NamesUnclear
from tests.support.posed_sets import check, frames, loaded, model, photos

SYSTEMS = {
    "cp932": "写真",
    "gb18030": "照片",
    "cp950": "圖片",
    "cp949": "사진",
    "cp1251": "Снимок",
    "cp866": "Снимок",
    "cp1252": "Gebäude",
    "cp852": "zdjęcie ł",
}


def in_bytes(encoding: str):
    return lambda text: text.encode(encoding)


def in_bytes_of_the_system(text: str) -> bytes:
    return text.encode("utf-8", "surrogateescape")


@pytest.mark.parametrize(("encoding", "word"), SYSTEMS.items(), ids=SYSTEMS.keys())
def test_names_in_the_encoding_of_a_system_are_those_of_the_photos(
    tmp_path: Path, encoding: str, word: str
) -> None:
    names = [f"{word} {k}.jpg" for k in range(4)]
    photos(tmp_path / "images", names)
    model(tmp_path / "sparse/0", dict(enumerate(names)), in_bytes(encoding))
    scene = loaded(tmp_path)
    check(scene, {name: k for k, name in enumerate(names)})
    assert scene.left_out == ()
    (warning,) = scene.warnings
    assert warning.startswith(f"The names in the COLMAP model are not UTF-8. They are read as {encoding} (")
    assert warning.endswith(f"as the photos are called: {word} 0.jpg.")


def test_a_binary_model_is_read_so_too(tmp_path: Path) -> None:
    names = [f"写真 {k}.jpg" for k in range(4)]
    photos(tmp_path / "images", names)
    ascii_names = [f"photo_{k}.jpg" for k in range(4)]
    model(tmp_path / "sparse/0", dict(enumerate(ascii_names)))
    (tmp_path / "sparse/0/points3D.txt").write_text(
        "# points\n"
    )  # COLMAP wants the features that tracks name
    read = pycolmap.Reconstruction(tmp_path / "sparse/0")
    for path in (tmp_path / "sparse/0").iterdir():
        path.unlink()
    read.write_binary(tmp_path / "sparse/0")
    path = tmp_path / "sparse/0/images.bin"
    path.write_bytes(path.read_bytes().replace(b"photo_", "写真 ".encode("cp932")))
    check(loaded(tmp_path), {name: k for k, name in enumerate(names)})


@pytest.mark.parametrize(("encoding", "word"), [*SYSTEMS.items(), ("cp932", "表ソ能")])
def test_transforms_in_the_encoding_of_a_system_name_the_photos(
    tmp_path: Path, encoding: str, word: str
) -> None:
    names = [f"{word} {k}.jpg" for k in range(4)]
    photos(tmp_path / "images", names)
    document = {"w": 64, "h": 48, "fl_x": 60, "fl_y": 61, "cx": 32, "cy": 24, "frames": frames(names)}
    text = json.dumps(document, ensure_ascii=False)
    (tmp_path / "transforms.json").write_bytes(text.encode(encoding))
    scene = loaded(tmp_path)
    check(scene, {name: k for k, name in enumerate(names)})
    assert scene.left_out == ()
    (warning,) = scene.warnings
    assert f" {encoding} (" in warning
    assert f"{word} 0.jpg" in warning


def test_two_readings_of_transforms_that_lead_to_different_photos_are_refused(tmp_path: Path) -> None:
    raw = "Снимок".encode("cp1251")
    both = [raw.decode("cp1251"), raw.decode("cp866")]
    photos(tmp_path / "images", [f"{word} {k}.jpg" for word in both for k in range(2)])
    text = json.dumps(
        {"camera_angle_x": 1.0, "frames": frames([f"Снимок {k}.jpg" for k in range(2)])}, ensure_ascii=False
    )
    (tmp_path / "transforms.json").write_bytes(text.encode("cp1251"))
    with pytest.raises(NamesUnclear) as refused:
        loaded(tmp_path)
    assert all(word in str(refused.value) for word in both)


def test_a_remark_in_another_encoding_leaves_names_in_ascii_as_they_are(tmp_path: Path) -> None:
    photos(tmp_path / "images", names := [f"{k}.jpg" for k in range(3)])
    text = json.dumps({"camera_angle_x": 1.0, "by": "Jürgen", "frames": frames(names)}, ensure_ascii=False)
    (tmp_path / "transforms.json").write_bytes(text.encode("cp1252"))
    scene = loaded(tmp_path)
    check(scene, {name: k for k, name in enumerate(names)})
    assert scene.warnings == ()


@pytest.mark.parametrize("kind", ["COLMAP", "transforms"])
def test_names_of_the_same_bytes_as_those_of_the_photos_are_theirs(tmp_path: Path, kind: str) -> None:
    """As copied from a system with another encoding: no photo can be stored under such a name."""
    there = [f"Geb\udce4ude {k}.jpg" for k in range(3)]
    stored = [storable_name(name) for name in there]
    photos(tmp_path / "images", stored)
    if kind == "COLMAP":
        model(tmp_path / "sparse/0", dict(enumerate([*there, "J\udcfcrgen.jpg"])), in_bytes_of_the_system)
    else:
        text = json.dumps(
            {"w": 64, "h": 48, "fl_x": 60, "frames": frames([*there, "J\udcfcrgen.jpg"])}, ensure_ascii=False
        )
        (tmp_path / "transforms.json").write_bytes(in_bytes_of_the_system(text))
    scene = loaded(tmp_path)
    check(scene, {name: k for k, name in enumerate(stored)})
    ((name, _),) = scene.left_out
    assert name.rpartition("/")[2] == "J\ufffdrgen.jpg"


def test_photos_in_folders_and_other_cases_are_found(tmp_path: Path) -> None:
    names = [f"День/СНИМОК {k}.JPG" for k in range(3)]
    photos(tmp_path / "images", names)
    model(
        tmp_path / "sparse/0",
        {k: name.replace("/", "\\").lower() for k, name in enumerate(names)},
        in_bytes("cp1251"),
    )
    check(loaded(tmp_path), {name: k for k, name in enumerate(names)})


def test_two_readings_that_lead_to_different_photos_are_refused(tmp_path: Path) -> None:
    raw = "Снимок".encode("cp1251")
    readings = [raw.decode("cp1251"), raw.decode("cp866")]
    photos(tmp_path / "images", [f"{word} {k}.jpg" for word in readings for k in range(2)])
    model(tmp_path / "sparse/0", {k: f"Снимок {k}.jpg" for k in range(2)}, in_bytes("cp1251"))
    with pytest.raises(ValueError, match="two readings of them lead to different photos") as refused:
        loaded(tmp_path)
    assert all(word in str(refused.value) for word in readings)


def test_names_that_are_those_of_no_photo_are_left_out(tmp_path: Path) -> None:
    photos(tmp_path / "images", ["a.jpg", "b.jpg"])
    model(tmp_path / "sparse/0", {0: "a.jpg", 1: "b.jpg", 2: "写真.jpg"}, in_bytes("cp932"))
    scene = loaded(tmp_path)
    check(scene, {"a.jpg": 0, "b.jpg": 1})
    assert [name.encode() for name, _ in scene.left_out]  # text alone, so that a report can be written


@pytest.mark.parametrize(
    ("folder", "shown"),
    [
        ("x/sparse/0", "sparse/0"),
        ("x/Sparse", "Sparse"),
        ("x/colmap/sparse/3", "colmap/sparse/3"),
        ("x/0", "0"),
        ("x/scene", ""),
    ],
)
def test_a_model_is_called_as_its_folder_is(folder: str, shown: str) -> None:
    assert colmap_files.place(Path(folder)) == shown


def test_a_damaged_model_is_called_by_its_place(tmp_path: Path) -> None:
    photos(tmp_path / "images")
    model(tmp_path / "sparse/0")
    (tmp_path / "sparse/0/images.txt").write_bytes(b"")
    with pytest.raises(ValueError, match=r"The COLMAP model in sparse/0 has no images\.txt"):
        loaded(tmp_path)
