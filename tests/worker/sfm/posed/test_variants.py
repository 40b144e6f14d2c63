"""Posed data sets as programs and people write them have the cameras that the plain one has, for the same photos.

Names with spaces, text of other programs and systems, photos in several sizes, and frames without a pose.
"""

import json
import shutil
import unicodedata
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatmill_worker.sfm.posed import text as model_text
from splatmill_worker.sfm.posed.model_files import read
from splatmill_worker.sfm.posed.written import model_of
from tests.support.posed_sets import ALL, NAMES, check, frames, image_lines, loaded, model, photos, transforms
from tests.worker.sfm.posed.test_posed import PLY

# Names with spaces in text.

SPACED = [
    "my photo (1).jpg",
    "two  spaces.jpg",
    "1 2 3.jpg",
    "at 9.41\u202fAM.png",
    "#1 first.jpg",
    "a b/c d.jpg",
]


def test_names_with_spaces_survive_the_text_that_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photos(tmp_path / "images", SPACED)
    model(tmp_path / "sparse/0", dict(enumerate(SPACED)))
    scene = loaded(tmp_path)
    shutil.rmtree(tmp_path / "sparse/0")
    (tmp_path / "sparse/0").mkdir()
    model_of(list(scene.views), scene.points, scene).write_binary(tmp_path / "sparse/0")
    before = read(tmp_path / "sparse/0").images
    assert model_text.main(tmp_path / "sparse/0") == 0
    assert f"names with spaces ({len(SPACED)})" in capsys.readouterr().err
    after = read(tmp_path / "sparse/0").images
    assert {image.name for image in after.values()} == set(SPACED)
    assert {k: image.name for k, image in after.items()} == {k: image.name for k, image in before.items()}
    check(loaded(tmp_path), {name: k for k, name in enumerate(SPACED)})


# Text as other programs write it.

WRITERS: dict[str, Callable[[str], bytes]] = {
    "a byte-order mark": lambda text: text.encode("utf-8-sig"),
    "CRLF": lambda text: text.replace("\n", "\r\n").encode(),
    "both": lambda text: text.replace("\n", "\r\n").encode("utf-8-sig"),
    "CR": lambda text: text.replace("\n", "\r").encode(),
    "UTF-16 of PowerShell": lambda text: text.replace("\n", "\r\n").encode("utf-16"),
    "tabs": lambda text: text.replace(" 1 view", "\t1\tview").encode(),
    "no comments": lambda text: "".join(
        line for line in text.splitlines(keepends=True) if not line.startswith("#")
    ).encode("utf-8-sig"),
    "no lines of features": lambda text: text.replace("\n\n", "\n").encode(),
    "spaces at the ends": lambda text: text.replace("\n", "  \n").encode(),
}


@pytest.mark.parametrize("writer", WRITERS)
def test_text_of_other_programs_is_read(tmp_path: Path, writer: str) -> None:
    photos(tmp_path / "colmap/images")
    model(tmp_path / "colmap/sparse/0", change=WRITERS[writer])
    scene = loaded(tmp_path / "colmap")
    check(scene, ALL)
    np.testing.assert_array_equal(scene.points, [[1, 2, 3]])
    photos(tmp_path / "nerf/images")
    transforms(tmp_path / "nerf/transforms.json", change=WRITERS[writer])
    check(loaded(tmp_path / "nerf"), ALL)


def test_features_are_not_taken_for_photos(tmp_path: Path) -> None:
    photos(tmp_path / "images")
    rows = [f"{line}\n1 2 -1 30 4.5 7 1e1 2 3 4 5 6\n" for line in image_lines(dict(enumerate(NAMES)))]
    model(tmp_path / "sparse/0")
    (tmp_path / "sparse/0/images.txt").write_text("".join(rows))
    check(loaded(tmp_path), ALL)


RENAMED: dict[str, Callable[[str], str]] = {
    "upper case": str.upper,
    "another case of the suffix": lambda name: name.replace(".jpg", ".JPG"),
    "title case": str.title,
    "a folder of Windows": lambda name: f"C:\\scene\\images\\{name}",
    "a relative folder of Windows": lambda name: f".\\images\\{name}",
    "no suffix": lambda name: name.removesuffix(".jpg"),
    "another suffix in another case": lambda name: name.upper().replace(".JPG", ".PNG"),
}


@pytest.mark.parametrize("kind", RENAMED)
def test_names_of_other_systems_are_matched(tmp_path: Path, kind: str) -> None:
    rename = RENAMED[kind]
    photos(tmp_path / "colmap/images")
    model(tmp_path / "colmap/sparse/0", {k: rename(name) for k, name in enumerate(NAMES)})
    check(loaded(tmp_path / "colmap"), ALL)
    photos(tmp_path / "nerf/images")
    entries = [frame | {"file_path": rename(name)} for name, frame in zip(NAMES, frames(), strict=True)]
    transforms(tmp_path / "nerf/transforms.json", entries)
    check(loaded(tmp_path / "nerf"), ALL)


def test_accents_match_in_both_forms_of_unicode(tmp_path: Path) -> None:
    names = [unicodedata.normalize("NFC", f"Gebäude {k}.jpg") for k in range(4)]
    photos(tmp_path / "images", names)
    model(tmp_path / "sparse/0", {k: unicodedata.normalize("NFD", name) for k, name in enumerate(names)})
    check(loaded(tmp_path), {name: k for k, name in enumerate(names)})


def test_names_that_differ_in_case_alone_stay_apart(tmp_path: Path) -> None:
    names = ["a.jpg", "A.jpg"]
    photos(tmp_path / "images", names)
    model(tmp_path / "sparse/0", dict(enumerate(names)))
    check(loaded(tmp_path), {"a.jpg": 0, "A.jpg": 1})


def test_files_of_a_model_may_have_another_case(tmp_path: Path) -> None:
    photos(tmp_path / "images")
    model(tmp_path / "Sparse/0")
    for path in list((tmp_path / "Sparse/0").iterdir()):
        path.rename(path.with_name(path.name.upper().replace("TXT", "txt")))
    check(loaded(tmp_path), ALL)


def test_a_blender_set_in_another_case_keeps_its_split(tmp_path: Path) -> None:
    photos(tmp_path / "images")
    transforms(tmp_path / "Transforms_Train.JSON", frames()[:9])
    transforms(tmp_path / "Transforms_Test.JSON", frames()[9:])
    scene = loaded(tmp_path)
    check(scene, ALL)
    assert [view.split for view in scene.views] == ["train"] * 9 + ["test"] * 3


def test_masks_and_points_with_backslashes_are_found(tmp_path: Path) -> None:
    photos(tmp_path / "images")
    photos(tmp_path / "cut", ["m.png"])
    entries = frames()
    entries[0]["mask_path"] = ".\\cut\\m.png"
    transforms(tmp_path / "transforms.json", entries)
    views = {view.name: view for view in loaded(tmp_path).views}
    assert views[NAMES[0]].mask == tmp_path / "cut/m.png"


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-be", "utf-32", "utf-32-le"])
def test_transforms_in_any_encoding_of_unicode(tmp_path: Path, encoding: str) -> None:
    photos(tmp_path / "images")
    transforms(tmp_path / "transforms.json", change=lambda text: text.encode(encoding))
    check(loaded(tmp_path), ALL)


def test_names_written_as_in_addresses_are_those_of_photos_masks_points_and_lists(tmp_path: Path) -> None:
    """The files keep their own names, whatever program encoded them."""
    photos(tmp_path / "images")
    photos(tmp_path / "my sam", ["cut out.png"])
    (tmp_path / "my points.ply").write_text(PLY)
    entries = frames([name.replace(" ", "%20") for name in NAMES])
    entries[0]["mask_path"] = "my%20sam/cut%20out.png"
    document = {"w": 64, "h": 48, "fl_x": 60, "fl_y": 61, "cx": 32, "cy": 24, "frames": entries}
    document |= {
        "ply_file_path": "my%20points.ply",
        "test_filenames": [f"images/{NAMES[2]}"],
        "train_filenames": [f"images/{name}" for name in (*NAMES[:2], *NAMES[3:])],
    }
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    scene = loaded(tmp_path)
    masks = {view.name: view.mask for view in scene.views if view.mask}
    assert masks[NAMES[0]] == tmp_path / "my sam/cut out.png"
    np.testing.assert_array_equal(scene.points, [[1, 2, 3]])
    assert [view.name for view in scene.views if view.split == "test"] == [NAMES[2]]
    assert not [warning for warning in scene.warnings if "points.ply" in warning]


@pytest.mark.parametrize("named", ["./masks/cut_0.png", "sam\\Cut_0.png", "/home/me/scan/sam/cut_0.png"])
def test_masks_of_a_capture_are_found_by_the_paths_that_frames_name(tmp_path: Path, named: str) -> None:
    photos(tmp_path / "images")
    stored = tmp_path / ("masks/cut_0.png" if "masks" in named else "masks/sam/cut_0.png")
    photos(stored.parent, [stored.name])
    entries = frames()
    entries[0]["mask_path"] = named
    entries[1]["mask_path"] = "sam/gone.png"
    (tmp_path / "poses").mkdir()
    transforms(tmp_path / "poses/transforms.json", entries)
    scene = loaded(tmp_path)
    assert {view.name: view.mask for view in scene.views if view.mask} == {NAMES[0]: stored}
    assert [each for each in scene.warnings if each.startswith("Masks that")] == [
        "Masks that transforms.json names are not in the capture, so that these photos have none: 1, such as "
        "sam/gone.png."
    ]


@pytest.mark.parametrize("folders", [("images_2", "images_4"), ("images", "images_2", "images_8")])
@pytest.mark.parametrize("root", ["", "images/"])
def test_of_photos_in_several_sizes_the_largest_are_used(
    tmp_path: Path, folders: tuple[str, ...], root: str
) -> None:
    for power, folder in enumerate(folders):
        photos(tmp_path / root / folder, size=(128 >> power, 96 >> power))
    model(tmp_path / "sparse/0")
    scene = loaded(tmp_path)
    inside = folders[0] == "images" and not root
    check(scene, {name if inside else f"{folders[0]}/{name}": k for name, k in ALL.items()})
    assert {view.camera.width for view in scene.views} == {128}
    assert scene.left_out == ()
    if not inside:
        (warning,) = scene.warnings
        assert f"12 photos are those of {folders[0]}/" in warning
        assert all(f"{folder}/" in warning for folder in folders)


def test_photos_that_are_there_twice_are_used_once(tmp_path: Path) -> None:
    photos(tmp_path / "images_2")
    photos(tmp_path / "images_4")
    transforms(tmp_path / "transforms.json")
    scene = loaded(tmp_path)
    check(scene, {f"images_2/{name}": k for name, k in ALL.items()})
    assert "12 photos are those of images_2/; images_4/ hold them again" in scene.warnings[0]
    assert scene.left_out == ()


def test_the_folder_that_the_cameras_name_is_used(tmp_path: Path) -> None:
    for folder, size in (("images_2", (128, 96)), ("images_4", (64, 48))):
        photos(tmp_path / folder, size=size)
    transforms(
        tmp_path / "transforms.json",
        [frame | {"file_path": f"images_4/{n}"} for n, frame in zip(NAMES, frames(), strict=True)],
    )
    assert {view.camera.width for view in loaded(tmp_path).views} == {64}


@pytest.mark.parametrize(
    ("folders", "sizes"), [(("left", "right"), (64, 32)), (("images_1", "images_2"), (64, 64))]
)
def test_photos_of_one_name_that_are_no_copies_are_refused_with_both_named(
    tmp_path: Path, folders: tuple[str, str], sizes: tuple[int, int]
) -> None:
    for folder, width in zip(folders, sizes, strict=True):
        photos(tmp_path / folder, NAMES if folder == folders[0] else NAMES[::-1], (width, width * 3 // 4))
    model(tmp_path / "sparse/0")
    with pytest.raises(ValueError, match=f"it may be {folders[0]}/view 00.jpg or {folders[1]}/view 00.jpg"):
        loaded(tmp_path)


# Frames without a pose.


@pytest.mark.parametrize("matrix", [None, [], "missing", "frame"])
def test_a_frame_without_a_pose_is_left_out(tmp_path: Path, matrix: object) -> None:
    photos(tmp_path / "images")
    entries: list[Any] = frames()
    if matrix == "frame":
        entries[7] = None
    elif matrix == "missing":
        del entries[7]["transform_matrix"]
    else:
        entries[7]["transform_matrix"] = matrix
    transforms(tmp_path / "transforms.json", entries)
    scene = loaded(tmp_path)
    check(scene, {name: k for name, k in ALL.items() if k != 7})
    assert "left out: 1 of 12 in transforms.json" in scene.warnings[0]
    expected = ["frame 7", NAMES[7]] if matrix == "frame" else [NAMES[7]]
    assert [name for name, _ in scene.left_out] == expected


@pytest.mark.parametrize("value", [float("nan"), 1e300, 0.0])
def test_one_frame_that_no_camera_can_be_is_left_out_and_several_are_refused(
    tmp_path: Path, value: float
) -> None:
    photos(tmp_path / "images")
    entries = frames()
    entries[7]["transform_matrix"] = [[value] * 4] * 4
    transforms(tmp_path / "transforms.json", entries)
    scene = loaded(tmp_path)
    check(scene, {name: k for name, k in ALL.items() if k != 7})
    ((name, reason),) = scene.left_out
    assert name == NAMES[7]
    assert "Frame 7" in reason
    entries[3]["transform_matrix"] = entries[7]["transform_matrix"]
    transforms(tmp_path / "transforms.json", entries)
    with pytest.raises(ValueError, match="Frame 3"):
        loaded(tmp_path)


def test_no_frame_with_a_pose_is_refused(tmp_path: Path) -> None:
    photos(tmp_path / "images")
    transforms(tmp_path / "transforms.json", [frame | {"transform_matrix": None} for frame in frames()])
    with pytest.raises(ValueError, match=r"No frame of transforms.json has a transform_matrix"):
        loaded(tmp_path)


@pytest.mark.parametrize("pose", ["0 0 0 0 1 2 3", "nan nan nan nan nan nan nan", "1 0 0 0 1e300 0 0"])
def test_one_pose_of_a_model_that_no_photo_can_have_is_left_out(tmp_path: Path, pose: str) -> None:
    photos(tmp_path / "images")
    lines = image_lines(dict(enumerate(NAMES)))
    lines[7] = f"8 {pose} 1 {NAMES[7]}"
    model(tmp_path / "sparse/0")
    (tmp_path / "sparse/0/images.txt").write_text("".join(f"{line}\n\n" for line in lines))
    scene = loaded(tmp_path)
    check(scene, {name: k for name, k in ALL.items() if k != 7})
    assert [name for name, _ in scene.left_out] == [NAMES[7]]
    assert "not valid" in scene.left_out[0][1]


@pytest.mark.parametrize("writer", ["colmap", "transforms"])
def test_a_photo_of_another_shape_than_its_camera_is_left_out(tmp_path: Path, writer: str) -> None:
    photos(tmp_path / "images")
    photos(tmp_path / "images", NAMES[3:4], size=(64, 36))
    if writer == "colmap":
        model(tmp_path / "sparse/0")
    else:
        transforms(tmp_path / "transforms.json")
    scene = loaded(tmp_path)
    assert len(scene.views) == len(NAMES) - 1
    reasons = dict(scene.left_out)
    assert "64 x 36 pixels, another shape than the 64 x 48" in next(
        v for k, v in reasons.items() if NAMES[3] in k
    )


# Names as in addresses.


def test_names_written_as_in_addresses_are_those_of_the_photos(tmp_path: Path) -> None:
    names = ["my view 1.jpg", "Küche.jpg", "100%.jpg", "a%20b.jpg", "a b.jpg"]
    photos(tmp_path / "images", names)
    transforms(tmp_path / "transforms.json", frames(["my%20view%201.jpg", "K%C3%BCche.jpg", *names[2:]]))
    scene = loaded(tmp_path)
    check(scene, {name: k for k, name in enumerate(names)})
    assert scene.left_out == ()


def test_cameras_of_other_photos_are_refused_with_a_photo_that_there_is(tmp_path: Path) -> None:
    photos(tmp_path / "images", ["IMG_0.jpg", "IMG_1.jpg"])
    transforms(tmp_path / "transforms.json", frames(["x.jpg", "y.jpg"]))
    with pytest.raises(ValueError, match=r"x\.jpg.*IMG_0\.jpg"):
        loaded(tmp_path)
