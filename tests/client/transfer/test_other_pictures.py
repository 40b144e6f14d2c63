"""Proves that folders of masks, depth maps and the like are no captures, and that maps beside photos are not used.

Not proven here: that the page says the same (tests/browser/new/test_new.py), and what pixels say
(images/test_no_photo.py).
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from splatmill.errors import NothingToUpload
from splatmill.schema import Role
from splatmill.schema.files.other_pictures import OTHER_FOLDERS
from splatmill.transfer.local_capture import find_files


def tree(root: Path, *names: str) -> None:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(b"x")


@pytest.mark.parametrize(
    ("what", "folder"), [(what, folder) for what, folders in OTHER_FOLDERS.items() for folder in folders]
)
def test_a_folder_with_such_a_name_is_refused_with_both_readings(
    tmp_path: Path, what: str, folder: str
) -> None:
    tree(tmp_path / folder.title(), "0.png", "left/1.jpg")
    with pytest.raises(NothingToUpload) as refused:
        find_files(tmp_path / folder.title())
    said = f"All 2 pictures lie in a folder of {what} by its name, such as {folder.title()}/0.png. "
    assert str(refused.value).startswith(said)
    assert "if these are the photos, give their folder another name" in str(refused.value)


def test_a_folder_of_nothing_but_such_folders_is_refused(tmp_path: Path) -> None:
    tree(tmp_path, "masks/0.png", "depth/0.png")
    with pytest.raises(NothingToUpload, match=r"All 2 pictures lie in a folder of depth maps or masks"):
        find_files(tmp_path)


def test_maps_beside_photos_are_no_photos(tmp_path: Path) -> None:
    tree(
        tmp_path,
        "rgb/0.jpg",
        "depth/0.png",
        "confidence/0.png",
        "Normals/0.png",
        "masks/0.png",
        "thumbs/0.jpg",
    )
    capture_files = find_files(tmp_path)
    assert {(file.role, file.name) for file in capture_files.files} == {
        (Role.images, "rgb/0.jpg"),
        (Role.images, "thumbs/0.jpg"),
        (Role.masks, "0.png"),
        (Role.poses, "depth/0.png"),
        (Role.poses, "confidence/0.png"),
    }
    assert capture_files.contents() == ["2 photos", "1 mask", "2 depth or confidence maps"]
    assert capture_files.ignored == ("Normals/0.png",)
    assert capture_files.remarks == (
        "1 picture is taken for normal maps by the name of the folder and not used: Normals/0.png.",
    )


def test_depth_maps_of_a_data_set_go_along_by_their_folder_or_by_their_frames(tmp_path: Path) -> None:
    tree(tmp_path / "set", "images/0.jpg", "images/1.jpg", "depths/0.png", "sensor/1.png", "rest/2.png")
    frames = [{"file_path": "images/0.jpg"}, {"file_path": "images/1.jpg", "depth_file_path": "sensor/1.png"}]
    (tmp_path / "set/transforms.json").write_text(json.dumps({"frames": frames}))
    poses = {file.name for file in find_files(tmp_path).files if file.role is Role.poses}
    assert poses == {"transforms.json", "depths/0.png", "sensor/1.png"}


def test_depth_maps_go_along_with_a_video(tmp_path: Path) -> None:
    tree(tmp_path, "rgb.mp4", "depth/000000.png", "confidence/000000.png", "odometry.csv")
    capture_files = find_files(tmp_path)
    assert [file.name for file in capture_files.files if file.role is Role.images] == ["rgb.mp4"]
    assert {file.name for file in capture_files.files if file.role is Role.poses} >= {
        "depth/000000.png",
        "confidence/000000.png",
    }
    assert any(
        "The cameras of Stray Scanner in odometry.csv are not read" in each for each in capture_files.remarks
    )


@pytest.mark.parametrize(
    "names",
    [
        ("images/0.jpg",),
        ("0.jpg", "masks/0.png"),
        ("0.jpg", "transforms.json"),
        ("images/depth/0.png", "images/1.jpg"),
    ],
)
def test_a_data_set_in_a_folder_with_such_a_name_is_read(tmp_path: Path, names: tuple[str, ...]) -> None:
    tree(tmp_path / "masks", *names)
    assert find_files(tmp_path / "masks").count(Role.images) == 1
