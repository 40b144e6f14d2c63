"""What a path contains: photos, masks and poses are found and named as the worker will look for them.

Does not prove that the files hold what their names say; only transforms.json is opened.
"""

from pathlib import Path

import pytest

from splatmill.errors import NothingToUpload
from splatmill.local_capture import find_files
from splatmill.schema import Role
from tests.support.paths import DATA

needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the shared data sets are not on this machine")


def tree(root: Path, *names: str) -> Path:
    for name in names:
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x" * 10)
    return root


def roles(path: Path) -> dict[Role, list[str]]:
    found = find_files(path)
    return {role: [file.name for file in found.files if file.role is role] for role in Role}


def test_a_folder_of_photos(tmp_path: Path):
    tree(
        tmp_path,
        "b.JPG",
        "a.heic",
        "day two/c.png",
        "notes.txt",
        ".hidden/d.jpg",
        "._a.jpg",
        "__MACOSX/e.jpg",
    )
    assert roles(tmp_path) == {
        Role.images: ["a.heic", "b.JPG", "day two/c.png"],
        Role.masks: [],
        Role.poses: [],
    }
    found = find_files(tmp_path)
    assert found.ignored == ("notes.txt",)
    assert found.bytes == 30


def test_masks_lie_beside_photos(tmp_path: Path):
    tree(
        tmp_path,
        "images/a.jpg",
        "images/left/b.jpg",
        "masks/a.jpg.png",
        "masks/left/b.png",
        "masks/readme.txt",
    )
    found = roles(tmp_path)
    assert found[Role.images] == ["a.jpg", "left/b.jpg"]
    assert found[Role.masks] == ["a.jpg.png", "left/b.png"]


def test_a_colmap_model_is_found_where_tools_put_it(tmp_path: Path):
    model = ("cameras.txt", "images.txt", "points3D.txt")
    for folder in ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse"):
        root = tmp_path / folder.replace("/", "_")
        tree(root, "images/a.jpg", *(f"{folder}/{name}" for name in model), f"{folder}/project.ini")
        assert roles(root)[Role.poses] == [f"sparse/0/{name}" for name in model]


def test_a_smaller_model_beside_the_first_is_left(tmp_path: Path):
    tree(tmp_path, "images/a.jpg", "sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/1/cameras.bin")
    assert roles(tmp_path)[Role.poses] == ["sparse/0/cameras.bin", "sparse/0/images.bin"]
    assert "sparse/1/cameras.bin" in find_files(tmp_path).ignored


@pytest.mark.parametrize("name", ["walk.MOV", "photos.zip", "one.jpg"])
def test_a_single_file(tmp_path: Path, name: str):
    tree(tmp_path, name)
    assert roles(tmp_path / name)[Role.images] == [name]


def test_a_video_counts_where_there_are_no_photos(tmp_path: Path):
    tree(tmp_path, "walk.mp4")
    assert roles(tmp_path)[Role.images] == ["walk.mp4"]
    tree(tmp_path, "IMG_1.heic")
    assert roles(tmp_path)[Role.images] == ["IMG_1.heic"]
    assert find_files(tmp_path).ignored == ("walk.mp4",)


def test_links_are_followed_but_not_in_circles(tmp_path: Path):
    tree(tmp_path, "shared/a.jpg", "set/masks/a.png")
    (tmp_path / "set" / "images").symlink_to(tmp_path / "shared")
    (tmp_path / "shared" / "again").symlink_to(tmp_path / "set")
    (tmp_path / "set" / "gone.jpg").symlink_to(tmp_path / "nowhere")
    assert roles(tmp_path / "set")[Role.images] == ["a.jpg"]


@pytest.mark.parametrize(
    "content", ['{"ply_file_path": "points3D.ply"}', '{"ply_file_path": "./points3D.ply"}']
)
def test_the_points_that_transforms_name_are_poses_and_other_files_are_not(tmp_path: Path, content: str):
    tree(tmp_path, "images/a.jpg", "points3D.ply", "other.ply")
    (tmp_path / "transforms.json").write_text(content)
    assert roles(tmp_path)[Role.poses] == ["points3D.ply", "transforms.json"]


@pytest.mark.parametrize(
    "content",
    ["rubbish", "[]", "{}", '{"ply_file_path": 3}', '{"ply_file_path": "../points3D.ply"}', "[" * 9999],
)
def test_transforms_without_such_points_are_sent_alone(tmp_path: Path, content: str):
    tree(tmp_path, "images/a.jpg", "points3D.ply")
    (tmp_path / "transforms.json").write_text(content)
    assert roles(tmp_path)[Role.poses] == ["transforms.json"]


def test_paths_with_nothing_to_train(tmp_path: Path):
    with pytest.raises(NothingToUpload, match="does not exist"):
        find_files(tmp_path / "nowhere")
    with pytest.raises(NothingToUpload, match="no photos"):
        find_files(tree(tmp_path, "notes.txt"))
    with pytest.raises(NothingToUpload, match=r"neither a photo"):
        find_files(tmp_path / "notes.txt")


def test_a_name_the_service_refuses_is_told_before_anything_is_sent(tmp_path: Path):
    with pytest.raises(NothingToUpload, match="backslash"):
        find_files(tree(tmp_path, "a\\b.jpg"))


@needs_data
def test_the_shared_data_sets():
    fox = roles(DATA / "fox_540x960")
    assert len(fox[Role.images]) == 50
    assert fox[Role.images][0] == "0001.jpg" or "/" not in fox[Role.images][0]
    assert "transforms.json" in fox[Role.poses]
    assert {"sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin"} <= set(fox[Role.poses])
    lego = roles(DATA / "lego_400")
    assert len(lego[Role.images]) == 125
    assert "train/r_0.png" in lego[Role.images]
    assert lego[Role.poses] == ["transforms_test.json", "transforms_train.json"]
    assert len(roles(DATA / "kermit_640x480")[Role.images]) == 11
