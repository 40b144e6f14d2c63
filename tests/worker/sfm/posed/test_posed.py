"""Proves that given cameras become OpenCV world-to-camera matrices of the right photos: COLMAP text and binary,
nerfstudio and instant-ngp transforms with distortion, Blender sets.

Not proven here: that given cameras are accurate.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatmill.schema import storable_name
from splatmill_worker.colmap import pycolmap
from splatmill_worker.images.load import load_views
from splatmill_worker.scene import split
from splatmill_worker.sfm import posed
from tests.support.paths import DATA

needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the shared data folder is not beside the project")


def rotation(angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def write_photos(folder: Path, names: list[str], size: tuple[int, int] = (64, 48)) -> None:
    for seed, name in enumerate(names):
        place = folder / name
        place.parent.mkdir(parents=True, exist_ok=True)
        pixels = np.random.default_rng(seed).integers(0, 256, (size[1], size[0], 3), np.uint8)
        Image.fromarray(pixels).save(place)


def write_transforms(path: Path, frames: list[dict[str, Any]], **values: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**values, "frames": frames}))


def opengl(center: list[float], angle: float = 0.0) -> list[list[float]]:
    matrix = np.eye(4)
    matrix[:3, :3] = rotation(angle)
    matrix[:3, 3] = center
    return matrix.tolist()


def test_transforms_become_opencv_world_to_camera(tmp_path: Path) -> None:
    """A camera at (1, 2, 3) looking along -z of OpenGL sees a point ahead at positive depth, y downwards."""
    write_photos(tmp_path / "images", ["a.png"])
    frame = {"file_path": "images/a.png", "transform_matrix": opengl([1.0, 2.0, 3.0])}
    write_transforms(
        tmp_path / "poses/transforms.json", [frame], fl_x=60.0, fl_y=61.0, cx=31.0, cy=25.0, w=64, h=48
    )
    poses = posed.find(tmp_path)
    assert poses is not None
    scene = poses.load()
    assert scene.source == "transforms"
    camera = scene.views[0].camera
    np.testing.assert_allclose(camera.center, [1.0, 2.0, 3.0], atol=1e-12)
    local = camera.viewmat @ np.array([1.0, 2.5, -1.0, 1.0])  # 4 ahead, 0.5 up
    np.testing.assert_allclose(local[:3], [0.0, -0.5, 4.0], atol=1e-12)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (60.0, 61.0, 31.0, 25.0)
    assert scene.views[0].lens is None


def test_distortion_and_the_size_of_the_files_are_honoured(tmp_path: Path) -> None:
    write_photos(tmp_path / "images", ["a.png"], (64, 48))
    frame = {"file_path": "a.png", "transform_matrix": opengl([0.0, 0.0, 0.0])}
    write_transforms(
        tmp_path / "transforms.json", [frame], fl_x=120.0, cx=64, cy=48, w=128, h=96, k1=0.05, p1=0.001
    )
    poses = posed.find(tmp_path)
    assert poses is not None
    view = poses.load().views[0]
    assert (view.camera.width, view.camera.height) == (64, 48)
    assert view.lens is not None
    assert view.lens.model == "OPENCV"
    assert view.lens.params == (120.0, 120.0, 64.0, 48.0, 0.05, 0.0, 0.001, 0.0)
    # The undistorted pinhole is zoomed so that its frame stays inside the photo, a few per cent here.
    assert 60.0 < view.camera.fx < 64.0
    assert load_views([view], 64)[0].rgb.shape == (48, 64, 3)


def test_names_are_found_by_suffix_and_without_extension(tmp_path: Path) -> None:
    write_photos(tmp_path / "images", ["left/a.png", "right/a.png", "b.jpg"])
    names = ["./data/left/a.png", "C:\\\\scene\\\\right\\\\a", "b", "gone.png"]
    frames = [
        {"file_path": name, "transform_matrix": opengl([float(k), 0, 0])} for k, name in enumerate(names)
    ]
    write_transforms(tmp_path / "poses/transforms.json", frames, camera_angle_x=1.0)
    poses = posed.find(tmp_path)
    assert poses is not None
    scene = poses.load()
    assert {view.name: view.camera.center[0] for view in scene.views} == {
        "left/a.png": 0.0,
        "right/a.png": 1.0,
        "b.jpg": 2.0,
    }
    assert [name for name, _ in scene.left_out] == ["gone.png"]
    assert scene.views[0].camera.fx == pytest.approx(0.5 * 64 / math.tan(0.5))


PLY = """ply
format ascii 1.0
element vertex 1
property float x
property float y
property float z
end_header
1 2 3
"""


def test_points_are_read_from_within_the_capture_alone(tmp_path: Path) -> None:
    capture = tmp_path / "capture"
    write_photos(capture / "images", ["a.png"])
    frame = {"file_path": "a.png", "transform_matrix": opengl([0.0, 0.0, 0.0])}
    for place in (tmp_path / "outside.ply", capture / "inside.ply"):
        place.write_text(PLY)
    (capture / "poses").mkdir()
    (capture / "poses" / "link.ply").symlink_to(tmp_path / "outside.ply")

    def points_named(name: str) -> tuple[int, tuple[str, ...]]:
        write_transforms(capture / "poses/transforms.json", [frame], camera_angle_x=1.0, ply_file_path=name)
        poses = posed.find(capture)
        assert poses is not None
        scene = poses.load()
        return len(scene.points), scene.warnings

    assert points_named("../inside.ply") == (1, ())
    for name in ("../../outside.ply", str(tmp_path / "outside.ply"), "link.ply"):
        count, notes = points_named(name)
        assert count == 0
        assert "lies outside the capture" in notes[0]


def test_a_blender_set_keeps_its_own_split(tmp_path: Path) -> None:
    write_photos(tmp_path, ["train/r_0.png", "train/r_1.png", "test/r_0.png", "val/r_0.png"])
    for part, count in (("train", 2), ("test", 1), ("val", 1)):
        frames = [
            {"file_path": f"./{part}/r_{k}", "transform_matrix": opengl([k, 0, 0])} for k in range(count)
        ]
        write_transforms(tmp_path / f"transforms_{part}.json", frames, camera_angle_x=0.7)
    poses = posed.find(tmp_path)
    assert poses is not None
    scene = poses.load()
    train, test = split(scene)
    assert scene.source == "blender"
    assert [view.name for view in train] == ["train/r_0.png", "train/r_1.png"]
    assert [view.name for view in test] == ["test/r_0.png"]


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (np.full((4, 4), np.nan), "not finite"),
        (np.zeros((4, 4)), "determinant"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "determinant"),
        (np.diag([1.0, 2.0, 1.0, 1.0]), "rigid"),
        (np.eye(2), "shape"),
        (np.array(opengl([1.0, 2.0, 3.0])).T, "probably transposed"),
    ],
)
def test_what_cannot_be_a_camera_is_refused_by_name(tmp_path: Path, matrix: np.ndarray, words: str) -> None:
    write_photos(tmp_path / "images", ["a.png"])
    frame = {"file_path": "a.png", "transform_matrix": matrix.tolist()}
    write_transforms(tmp_path / "transforms.json", [frame], camera_angle_x=1.0)
    poses = posed.find(tmp_path)
    assert poses is not None
    with pytest.raises(ValueError, match=words) as error:
        poses.load()
    assert "transforms.json" in str(error.value)
    assert "a.png" in str(error.value)


def test_an_empty_list_of_frames_is_called_that(tmp_path: Path) -> None:
    write_photos(tmp_path / "images", ["a.png"])
    write_transforms(tmp_path / "transforms.json", [], camera_angle_x=1.0)
    poses = posed.find(tmp_path)
    assert poses is not None
    with pytest.raises(ValueError, match=r"transforms\.json has no frames: it places no photo\."):
        poses.load()


def colmap_model() -> pycolmap.Reconstruction:
    """Two photos of 128 x 96, a metre apart, and three points both see."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs = 1
    options.num_cameras_per_rig = 1
    options.num_frames_per_rig = 4
    options.num_points3D = 30
    pycolmap.set_random_seed(0)
    return pycolmap.synthesize_dataset(options)


@pytest.mark.parametrize("form", ["text", "binary"])
def test_a_colmap_model_is_read_in_both_forms(tmp_path: Path, form: str) -> None:
    model = colmap_model()
    folder = tmp_path / "poses/sparse/0"
    folder.mkdir(parents=True)
    (model.write_text if form == "text" else model.write_binary)(folder)
    camera = next(iter(model.cameras.values()))
    half = camera.width // 2, camera.height // 2
    names = sorted(image.name for image in model.images.values())
    write_photos(tmp_path / "images", names[1:], half)
    poses = posed.find(tmp_path)
    assert poses is not None
    scene = poses.load()
    assert scene.source == "colmap"
    assert [view.name for view in scene.views] == names[1:]
    assert [name for name, _ in scene.left_out] == names[:1]
    by_name = {image.name: image for image in model.images.values()}
    for view in scene.views:
        expected = by_name[view.name].cam_from_world().matrix()
        # Text files hold 17 digits.
        np.testing.assert_allclose(view.camera.viewmat[:3], expected, atol=1e-9)
        assert (view.camera.width, view.camera.height) == half
    assert len(scene.points) == model.num_points3D()
    assert scene.point_views is not None
    assert scene.track_lengths is not None
    np.testing.assert_array_equal(np.diff(scene.point_views.offsets), scene.track_lengths)


def test_a_colmap_model_wins_over_transforms(tmp_path: Path) -> None:
    model = colmap_model()
    (tmp_path / "sparse/0").mkdir(parents=True)
    model.write_binary(tmp_path / "sparse/0")
    write_photos(tmp_path / "images", [image.name for image in model.images.values()])
    write_transforms(tmp_path / "transforms.json", [])
    poses = posed.find(tmp_path)
    assert poses is not None
    assert (poses.source, len(poses.warnings)) == ("colmap", 1)


def test_a_broken_model_and_missing_photos_are_named(tmp_path: Path) -> None:
    folder = tmp_path / "sparse/0"
    folder.mkdir(parents=True)
    for name in ("cameras", "images", "points3D"):
        (folder / f"{name}.bin").write_bytes(b"\x01\x02\x03")
    poses = posed.find(tmp_path)
    assert poses is not None
    with pytest.raises(ValueError, match="could not be read"):
        poses.load()
    colmap_model().write_binary(folder)
    poses = posed.find(tmp_path)
    assert poses is not None
    with pytest.raises(ValueError, match="the capture has none of them"):
        poses.load()


def test_a_folder_of_photos_alone_has_no_cameras(tmp_path: Path) -> None:
    write_photos(tmp_path / "images", ["a.png"])
    assert posed.find(tmp_path) is None


@needs_data
def test_fox_and_lego_load_whole() -> None:
    fox = posed.find(DATA / "fox_540x960")
    assert fox is not None
    scene = fox.load()
    assert (len(scene.views), len(scene.points)) == (50, 11450)
    photo = load_views(scene.views[:1], 480)[0]
    assert photo.rgb.shape == (480, 270, 3)
    lego = posed.find(DATA / "lego_400")
    assert lego is not None
    train, test = split(lego.load())
    assert (len(train), len(test)) == (100, 25)
    assert load_views(train[:1], 400)[0].alpha is not None


@needs_data
def test_both_sources_of_fox_agree() -> None:
    """transforms.json and the COLMAP model come from two reconstructions of the same photos."""
    folder = DATA / "fox_540x960"
    model = posed.find(folder)
    assert model is not None
    scene = model.load()
    other = posed.PosedInput(folder, "transforms", (), (folder / "transforms.json",)).load()
    poses = {view.name: view.camera for view in other.views}
    pairs = [(view.camera, poses[view.name]) for view in scene.views if view.name in poses]
    assert len(pairs) == 50
    # Relative rotations need no alignment of the two worlds.
    first = pairs[0]
    for ours, theirs in pairs[1:]:
        a = ours.viewmat[:3, :3] @ first[0].viewmat[:3, :3].T
        b = theirs.viewmat[:3, :3] @ first[1].viewmat[:3, :3].T
        angle = math.degrees(math.acos(min(1.0, (np.trace(a @ b.T) - 1.0) / 2.0)))
        assert angle < 2.0  # they agree to about 0.8 degrees: their principal points differ by 7 pixels


def test_a_photo_that_was_renamed_for_storage_has_its_camera(tmp_path: Path) -> None:
    names = ["x:1.png", " lead.png", "plain.png"]
    for name in names:
        (tmp_path / "images").mkdir(exist_ok=True)
        Image.new("RGB", (64, 48)).save(tmp_path / "images" / storable_name(name))
    frames = [{"file_path": f"images/{name}", "transform_matrix": np.eye(4).tolist()} for name in names]
    document = {"fl_x": 60.0, "w": 64, "h": 48, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    poses = posed.find(tmp_path)
    assert poses is not None
    scene = poses.load()
    assert {view.name for view in scene.views} == {storable_name(name) for name in names}
    assert scene.left_out == ()
