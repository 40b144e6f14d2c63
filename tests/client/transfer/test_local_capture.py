"""What a path contains: photos, masks and poses are found and named as the worker will look for them.

Does not prove that the files hold what their names say; only transforms.json is opened.
"""

import json
import os
import re
from pathlib import Path

import pytest

from splatmill.cli.commands.models.models import FILES, OPTIONAL_FILES
from splatmill.data_sets import find_cameras, walk
from splatmill.errors import NothingToUpload
from splatmill.schema import OUTPUT_MARKS, OUTPUT_MEDIA, Role, safe_name
from splatmill.schema.files.masks import paired
from splatmill.transfer.local_capture import find_files, printable
from tests.support.paths import DATA

needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the shared data sets are not on this machine")


def tree(root: Path, *names: str) -> Path:
    for name in names:
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x" * 10)
    return root


def roles(path: Path) -> dict[Role, list[str]]:
    capture_files = find_files(path)
    return {role: [file.name for file in capture_files.files if file.role is role] for role in Role}


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
    capture_files = find_files(tmp_path)
    assert capture_files.ignored == ("notes.txt",)
    assert capture_files.bytes == 30


@pytest.mark.parametrize(
    ("mask", "name"),
    [
        ("images/a_mask.png", "a_mask.png"),
        ("images/a.mask.PNG", "a.mask.PNG"),
        ("images/left/Mask_B.png", "left/Mask_B.png"),
        ("Masks/a.PNG", "a.PNG"),
        ("segmentation/left/b.png", "left/b.png"),
        ("images/mask/a.png", "a.png"),
    ],
)
def test_masks_of_other_programs(tmp_path: Path, mask: str, name: str) -> None:
    tree(tmp_path, "images/a.jpg", "images/left/b.jpg", "images/gas_mask.jpg", mask)
    assert roles(tmp_path) == {
        Role.images: ["a.jpg", "gas_mask.jpg", "left/b.jpg"],
        Role.masks: [name],
        Role.poses: [],
    }


def test_masks_of_a_data_set_some_folders_down(tmp_path: Path) -> None:
    tree(
        tmp_path,
        *(
            f"masks/set/{name}"
            for name in ("images/a.jpg", "images/b.jpg", "images/b_mask.png", "transforms.json")
        ),
        "masks/set/segmentation/a.png",
        "masks/other.png",
    )
    assert roles(tmp_path) == {
        Role.images: ["a.jpg", "b.jpg"],
        Role.masks: ["b_mask.png", "a.png"],
        Role.poses: ["transforms.json"],
    }
    assert find_files(tmp_path).ignored == ("masks/other.png",)


def test_masks_lie_beside_photos(tmp_path: Path):
    tree(
        tmp_path,
        "images/a.jpg",
        "images/left/b.jpg",
        "masks/a.jpg.png",
        "masks/left/b.png",
        "masks/readme.txt",
    )
    names = roles(tmp_path)
    assert names[Role.images] == ["a.jpg", "left/b.jpg"]
    assert names[Role.masks] == ["a.jpg.png", "left/b.png"]


def test_a_colmap_model_is_found_where_tools_put_it(tmp_path: Path):
    model = ("cameras.txt", "images.txt", "points3D.txt")
    for folder in ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse"):
        root = tmp_path / folder.replace("/", "_")
        tree(root, "images/a.jpg", *(f"{folder}/{name}" for name in model), f"{folder}/project.ini")
        assert roles(root)[Role.poses] == [f"{folder}/{name}" for name in model]


def test_a_model_keeps_its_place_in_the_data_set_so_that_messages_name_it(tmp_path: Path):
    for folder, place in (
        ("", ""),
        ("scan/", ""),
        ("scan/0/", "0/"),
        ("scan/colmap/sparse/", "colmap/sparse/"),
    ):
        root = tmp_path / f"of-{folder.replace('/', '_')}"
        top = "scan/" if folder else ""
        tree(root, f"{top}images/a.jpg", f"{folder}cameras.txt", f"{folder}images.txt")
        capture = roles(root)[Role.poses]
        assert capture == [f"{place}cameras.txt", f"{place}images.txt"]
        cameras = find_cameras(capture)
        assert cameras is not None
        assert cameras.models == (place,)


def test_all_models_of_a_mapper_are_sent_because_the_largest_is_chosen_by_its_photos(tmp_path: Path):
    model = ("cameras.bin", "images.bin")
    tree(tmp_path, "images/a.jpg", *(f"sparse/{k}/{name}" for k in (0, 2, 10) for name in model))
    assert roles(tmp_path)[Role.poses] == [f"sparse/{k}/{name}" for k in (0, 10, 2) for name in model]
    cameras = find_cameras(walk(tmp_path))
    assert cameras is not None
    assert cameras.models == ("sparse/0/", "sparse/2/", "sparse/10/")


MODEL = ("sparse/0/cameras.bin", "sparse/0/images.bin")
NESTED = {
    "one folder down": ("scene/", "scene/images/", [f"scene/{name}" for name in MODEL]),
    "beside a readme": ("scene/", "scene/images/", ["readme.txt", *(f"scene/{name}" for name in MODEL)]),
    "four down": ("a/b/c/d/", "a/b/c/d/images/", [f"a/b/c/d/{name}" for name in MODEL]),
    "transforms of another program": ("export/", "export/frames/", ["export/transforms.json"]),
    "the photos beside it": ("export/", "photos/", [f"export/{name}" for name in MODEL]),
    "undistorted by COLMAP": (
        "dense/0/",
        "dense/0/images/",
        ["dense/0/sparse/cameras.bin", "dense/0/sparse/images.bin"],
    ),
    "in other cases": (
        "Scene/",
        "Scene/images/",
        ["Scene/Sparse/0/Cameras.bin", "Scene/Sparse/0/Images.bin"],
    ),
}


@pytest.mark.parametrize("kind", NESTED)
def test_a_data_set_some_folders_down_is_found(tmp_path: Path, kind: str):
    top, photos, poses = NESTED[kind]
    tree(tmp_path, f"{photos}a.jpg", f"{photos}b.jpg", *poses)
    capture_files = find_files(tmp_path)
    assert capture_files.top == top
    assert [Path(file.name).name for file in capture_files.files if file.role is Role.images] == [
        "a.jpg",
        "b.jpg",
    ]
    sent = [file.name for file in capture_files.files if file.role is Role.poses]
    assert len(sent) == len([name for name in poses if name != "readme.txt"])
    assert all(f"{top}{name}" in poses for name in sent)


def test_two_data_sets_side_by_side_are_refused_with_both_named(tmp_path: Path):
    for scene in ("chair", "table"):
        tree(tmp_path, f"{scene}/images/a.jpg", *(f"{scene}/{name}" for name in MODEL))
    with pytest.raises(NothingToUpload, match="chair/ and in table/"):
        find_files(tmp_path)


@pytest.mark.parametrize(
    ("names", "top"),
    [
        (["a/transforms.json", "transforms.json"], ""),  # the outermost
        (["a/cameras.txt"], None),  # no model without its images
        (["a/b/c/d/e/transforms.json"], None),  # too deep
    ],
)
def test_files_that_are_no_second_data_set(names: list[str], top: str | None):
    cameras = find_cameras(names)
    assert (cameras.top if cameras is not None else None) == top


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
    "content",
    [
        '{"ply_file_path": "points3D.ply"}',
        '{"ply_file_path": "./points3D.ply"}',
        '\ufeff{"ply_file_path": ".\\\\points3D.ply"}',
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "utf-16-be", "utf-32"])
def test_the_points_that_transforms_name_are_poses_and_other_files_are_not(
    tmp_path: Path, content: str, encoding: str
):
    tree(tmp_path, "images/a.jpg", "points3D.ply", "other.ply")
    content = content if encoding == "utf-8" else content.removeprefix("\ufeff")
    (tmp_path / "transforms.json").write_text(content, encoding)
    assert roles(tmp_path)[Role.poses] == ["points3D.ply", "transforms.json"]


@pytest.mark.parametrize(
    "content",
    ["rubbish", "[]", "{}", '{"ply_file_path": 3}', '{"ply_file_path": "../points3D.ply"}', "[" * 9999],
)
def test_transforms_without_such_points_are_sent_alone(tmp_path: Path, content: str):
    tree(tmp_path, "images/a.jpg", "points3D.ply")
    (tmp_path / "transforms.json").write_text(content)
    assert roles(tmp_path)[Role.poses] == ["transforms.json"]


@pytest.mark.parametrize(
    ("named", "stored"),
    [
        ("sam/obj_0.png", "sam/obj_0.png"),
        (".\\\\sam\\\\obj_0.png", "sam/obj_0.png"),
        ("masks/obj_0.png", "obj_0.png"),
        ("images/obj_0.png", "obj_0.png"),
        ("my%20sam/obj%200.png", "my sam/obj 0.png"),
    ],
)
def test_the_masks_that_frames_name_are_masks(tmp_path: Path, named: str, stored: str):
    path = named.replace("\\\\", "/").removeprefix("./").replace("%20", " ")
    tree(tmp_path, "images/a.jpg", path, "sam/other.png")
    (tmp_path / "transforms.json").write_text(
        f'{{"frames": [null, {{"file_path": "images/a.jpg", "mask_path": "{named}"}}]}}'
    )
    assert roles(tmp_path) == {
        Role.images: ["a.jpg"],
        Role.masks: [stored],
        Role.poses: ["transforms.json"],
    }


@pytest.mark.parametrize(
    ("named", "photos"),
    [
        ("more/b.jpg", ["images/a.jpg", "more/b.jpg"]),
        ("images_4/a.jpg", ["a.jpg"]),
        ("images/a.jpg", ["a.jpg"]),
        ("more/missing.jpg", ["a.jpg"]),
    ],
)
def test_photos_beside_the_folder_images_are_used_where_cameras_name_them(
    tmp_path: Path, named: str, photos: list[str]
):
    tree(tmp_path, "images/a.jpg", "more/b.jpg", "images_4/a.jpg")
    (tmp_path / "transforms.json").write_text(f'{{"frames": [{{"file_path": "./{named}"}}]}}')
    names = roles(tmp_path)[Role.images]
    assert [name for name in names if not name.startswith("images_4")] == photos


def test_a_folder_of_results_alone_is_called_that(tmp_path: Path):
    tree(tmp_path, "model.ply", "report.json", "cameras.json", "preview.jpg")
    with pytest.raises(NothingToUpload, match="no photos") as error:
        find_files(tmp_path)
    assert "Results of an earlier training are not read: cameras.json, preview.jpg." in str(error.value)


def test_paths_with_nothing_to_train(tmp_path: Path):
    with pytest.raises(NothingToUpload, match="does not exist"):
        find_files(tmp_path / "nowhere")
    (tmp_path / "gone").symlink_to("nowhere")
    with pytest.raises(NothingToUpload, match=r"gone is a link to nothing\."):
        find_files(tmp_path / "gone")
    os.mkfifo(tmp_path / "pipe.zip")
    with pytest.raises(NothingToUpload, match=r"pipe\.zip is a device, a socket or a pipe, not a file\."):
        find_files(tmp_path / "pipe.zip")
    with pytest.raises(NothingToUpload, match="no photos"):
        find_files(tree(tmp_path / "empty", "notes.txt"))
    with pytest.raises(NothingToUpload, match=r"neither a photo"):
        find_files(tmp_path / "empty/notes.txt")


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (["a.jpg", "b.DNG", "c.dng"], ["Not read are raw photos: b.DNG and 1 more. Develop them as JPEG"]),
        (
            ["a.jpg", "photos.rar", "old.bmp"],
            ["pictures of other formats: old.bmp. Save", "other formats: photos.rar"],
        ),
        (["a.jpg", "x/VID_1.insv"], ["360-degree camera: x/VID_1.insv. Export flat"]),
        (["images/a.jpg", "opensfm/reconstruction.json"], []),
        (
            ["a.jpg", "scene.SFM", "Poses_Bounds.npy"],
            ["Meshroom in scene.SFM", "LLFF in Poses_Bounds.npy"],
        ),
        (["images/a.jpg", "sparse/0/cameras.bin", "sparse/0/images.bin", "cameras.xml"], []),
        (["a.jpg", "clip.mp4", "more.zip"], ["not used where there are photos: clip.mp4, more.zip"]),
        (
            ["a.jpg", "sparse/0/images.bin", "sparse/0/points3D.bin"],
            ["sparse/0/images.bin is not read: cameras are rec"],
        ),
        (
            ["a.jpg", "1/2/3/4/5/Transforms.json"],
            ["1/2/3/4/5/Transforms.json is not read: cameras are recovered"],
        ),
        (["a.jpg", "notes.txt", "data.json", "x.xml"], []),
        (["clip.mp4", "C0001M01.XML"], ["beside a video or a zip these files are not used: C0001M01.XML."]),
        (["more.zip", "cameras.csv"], ["beside a video or a zip these files are not used: cameras.csv."]),
    ],
)
def test_what_holds_photos_or_cameras_and_is_not_read_is_said(
    tmp_path: Path, names: list[str], said: list[str]
) -> None:
    remarks = find_files(tree(tmp_path, *names)).remarks
    assert len(remarks) == len(said)
    assert all(part in sentence for part, sentence in zip(said, remarks, strict=True))


@pytest.mark.parametrize("name", ["IMG_1.cr3", "scan.7z", "a.gif", "v.mts"])
def test_a_kind_that_is_not_read_is_refused_with_what_to_do(tmp_path: Path, name: str) -> None:
    tree(tmp_path, name)
    for path in (tmp_path, tmp_path / name):
        with pytest.raises(
            NothingToUpload, match=r"Develop them|Unpack them|Save them|Convert them"
        ) as refused:
            find_files(path)
        assert name in str(refused.value)


@pytest.mark.parametrize(
    ("bad", "stem"),
    [
        (b"x:1.jpg", "x_1"),
        (b" lead.jpg", "lead"),
        (b"caf\xe9.jpg", "caf_"),
        (b"a\\b.jpg", "a_b"),
        (b"line\nbreak.jpg", "line_break"),
        ("写".encode() * 80 + b".jpg", "写" * 62),
        (b" day /1.jpg", "day"),
    ],
)
def test_one_bad_name_is_changed_and_the_others_stay(tmp_path: Path, bad: bytes, stem: str) -> None:
    tree(tmp_path, *(f"{number}.jpg" for number in range(30)))
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + bad))
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b"x")
    capture_files = find_files(tmp_path)
    names = {file.path: file.name for file in capture_files.files}
    assert len(names) == 31
    stored = names[path]
    assert re.fullmatch(rf"{stem}-[0-9a-f]{{8}}(/1)?\.jpg", stored)
    assert safe_name(stored) == stored
    assert capture_files.renamed == ((os.fsdecode(bad), stored),)
    assert capture_files.left_out == ()
    assert set(names.values()) == {f"{number}.jpg" for number in range(30)} | {stored}
    assert printable(os.fsdecode(bad)).encode()  # no terminal or JSON fails on it


def test_a_photo_and_its_mask_are_renamed_alike_and_no_name_is_taken(tmp_path: Path) -> None:
    tree(tmp_path, "images/x:1.jpg", "images/x_1.jpg", "images/y:1.jpg", "masks/x:1.png")
    capture_files = find_files(tmp_path)
    names = {(file.role, file.path.name): file.name for file in capture_files.files}
    assert len(set(names.values())) == 4
    photos = [name for (role, _), name in names.items() if role is Role.images]
    assert paired(photos, [names[Role.masks, "x:1.png"]]) == {
        names[Role.images, "x:1.jpg"]: names[Role.masks, "x:1.png"]
    }


def test_photos_with_rare_suffixes(tmp_path: Path) -> None:
    names = ["a.jfif", "b.JPE", "c.avif", "d.JFIF"]
    tree(tmp_path, *names)
    assert roles(tmp_path)[Role.images] == names


def test_results_among_the_photos_are_no_photos(tmp_path: Path) -> None:
    results = [f"out/{name}" for name in (*FILES, *OPTIONAL_FILES, "novel_view.png", "orbit.mp4")]
    tree(tmp_path, "1.jpg", "2.jpg", "preview.jpg", "out/mine.jpg", *results)
    capture_files = find_files(tmp_path)
    # Of a picture that somebody put there, and of a preview that was copied, nothing says that it is a result.
    assert [file.name for file in capture_files.files] == ["1.jpg", "2.jpg", "out/mine.jpg", "preview.jpg"]
    assert capture_files.outputs == tuple(sorted(f"out/{name}" for name in OUTPUT_MEDIA))


def test_results_beside_the_photos_and_after_an_interruption(tmp_path: Path) -> None:
    # The files are downloaded in the order of FILES: no picture is there before two files that mark the folder.
    assert set(FILES[:2]) <= set(OUTPUT_MARKS)
    tree(tmp_path, "1.jpg", "2.jpg", "model.ply", "report.json", "report.png")
    assert [file.name for file in find_files(tmp_path).files] == ["1.jpg", "2.jpg"]


def test_results_beside_a_video_are_no_video_and_no_zip(tmp_path: Path) -> None:
    tree(tmp_path, "walk.mp4", *(f"splat/{name}" for name in (*FILES, "orbit.mp4")))
    assert [file.name for file in find_files(tmp_path).files] == ["walk.mp4"]


def test_pictures_beside_the_report_of_another_program_are_photos(tmp_path: Path) -> None:
    tree(tmp_path, "1.jpg", "preview.jpg", "report.json")
    assert [file.name for file in find_files(tmp_path).files] == ["1.jpg", "preview.jpg"]


def test_a_name_that_cannot_be_changed_is_left_out(tmp_path: Path) -> None:
    deep = "/".join(["a"] * 17)
    tree(tmp_path, "1.jpg", f"{deep}.jpg")
    capture_files = find_files(tmp_path)
    assert [file.name for file in capture_files.files] == ["1.jpg"]
    [(name, reason)] = capture_files.left_out
    assert name == f"{deep}.jpg"
    assert "17 parts" in reason
    (tmp_path / "1.jpg").unlink()
    with pytest.raises(NothingToUpload, match="17 parts"):
        find_files(tmp_path)


ODD = {
    "odd.jpg": ("a link to nothing", lambda path: path.symlink_to("/nowhere/x.jpg")),
    "self.png": ("a link to nothing", lambda path: path.symlink_to(path)),
    "pipe.jpg": ("a device, a socket or a pipe", os.mkfifo),
    "null.jpg": ("a device, a socket or a pipe", lambda path: path.symlink_to("/dev/null")),
    "a_mask.png": ("a device, a socket or a pipe", os.mkfifo),
    "masks/b.png": ("a link to nothing", lambda path: path.symlink_to("gone.png")),
    "transforms.json": ("a device, a socket or a pipe", os.mkfifo),
    "sparse/0/cameras.bin": ("a link to nothing", lambda path: path.symlink_to("gone.bin")),
}


@pytest.mark.timeout(20)
@pytest.mark.parametrize("name", ODD)
def test_what_is_no_regular_file_is_left_out_by_name(tmp_path: Path, name: str) -> None:
    tree(tmp_path, "a.jpg", "b.jpg", "x.jpg/c.jpg")
    reason, make = ODD[name]
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    make(tmp_path / name)
    (tmp_path / "loop").symlink_to(tmp_path)
    (tmp_path / "a_link").symlink_to(tmp_path / "x.jpg")
    capture_files = find_files(tmp_path)
    assert [(file.role, file.name) for file in capture_files.files] == [
        (Role.images, each) for each in ("a.jpg", "b.jpg", "x.jpg/c.jpg")
    ]
    assert [each for each in capture_files.remarks if each.startswith("Left out")] == [
        f"Left out are {name}: it is {reason}{', not a file' if 'pipe' in reason else ''}."
    ]
    for path in ("a.jpg", "b.jpg", "x.jpg/c.jpg"):
        (tmp_path / path).unlink()
    with pytest.raises(NothingToUpload, match=f"Left out are {name}: it is {reason}"):
        find_files(tmp_path)


def test_a_folder_of_photos_may_be_a_link(tmp_path: Path) -> None:
    tree(tmp_path / "store", "1.jpg", "deep/2.jpg")
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene/images").symlink_to(tmp_path / "store")
    (tmp_path / "scene/store").symlink_to(tmp_path / "store/deep")
    names = [file.path.relative_to(tmp_path).as_posix() for file in find_files(tmp_path / "scene").files]
    assert names == ["scene/images/1.jpg", "scene/images/deep/2.jpg"]


def test_what_may_not_be_read_is_left_out_by_name(tmp_path: Path) -> None:
    tree(tmp_path, "a.jpg", "b.jpg", "closed/c.jpg")
    tmp_path.chmod(0o755)
    (tmp_path / "b.jpg").chmod(0)
    (tmp_path / "closed").chmod(0)
    left_out: dict[str, str] = {}
    reader, writer = os.pipe()
    if os.fork() == 0:
        try:
            os.chdir(tmp_path)
            if os.geteuid() == 0:
                os.setuid(65534)  # whom permissions bind
            os.write(writer, json.dumps([walk(Path("."), left_out), left_out]).encode())
        finally:
            os._exit(0)
    os.close(writer)
    denied = "it cannot be read: Permission denied"
    with os.fdopen(reader) as answer:
        assert json.loads(answer.read()) == [["a.jpg"], {"b.jpg": denied, "closed": denied}]
    os.wait()


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


@pytest.mark.parametrize(
    "part",
    ["transforms.json", "database.db", "sparse", "sparse/0", "sparse/0/cameras.txt", "sparse/0/points3D.txt"],
)
def test_a_part_of_a_data_set_stands_for_the_whole(tmp_path: Path, part: str) -> None:
    whole = tree(
        tmp_path / "2024",
        "images/a.jpg",
        "sparse/0/cameras.txt",
        "sparse/0/images.txt",
        "sparse/0/points3D.txt",
    )
    tree(whole, "transforms.json", "database.db")
    capture_files = find_files(whole / part)
    assert capture_files.contents() == ["1 photo", "4 pose files"]
    assert str(whole) in capture_files.remarks[0]
    assert find_files(whole).remarks == ()


def test_parts_without_photos_around_them_stay_what_they_are(tmp_path: Path) -> None:
    tree(tmp_path / "home", "0/cameras.txt", "0/images.txt", "notes.txt")
    with pytest.raises(NothingToUpload, match="home/0 contains no photos"):
        find_files(tmp_path / "home/0")
    with pytest.raises(NothingToUpload, match=r"cameras\.txt is neither"):
        find_files(tmp_path / "home/0/cameras.txt")


def test_cameras_beside_a_folder_of_photos_are_named(tmp_path: Path) -> None:
    tree(tmp_path, "images/a.jpg", "sparse/0/cameras.txt", "transforms.json")
    (said,) = find_files(tmp_path / "images").remarks
    assert said == f"Cameras lie beside this folder: sparse, transforms.json. To use them, give {tmp_path}."


@pytest.mark.parametrize(
    ("names", "contents"),
    [
        (["a.jpg"], ["1 photo"]),
        (["a.zip"], ["1 zip archive"]),
        (["a.mp4", "b.MOV"], ["2 videos"]),
        (["a.jpg", "b.jpg", "masks/a.png"], ["2 photos", "1 mask"]),
    ],
)
def test_files_are_counted_by_their_kind(tmp_path: Path, names: list[str], contents: list[str]) -> None:
    assert find_files(tree(tmp_path, *names)).contents() == contents
