"""Proves that cameras in files of Metashape, RealityScan, Bundler, OpenSfM, VisualSFM, 3D Gaussian Splatting and
Record3D become those of the same capture in the form of COLMAP: poses to 1e-6, and pixels, by the formulas of these
programs, to 0.01. Wrong files are refused.

Not proven here: that a release of such a program writes what its manual says.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from splatmill.transfer.local_capture import find_files
from splatmill_worker.colmap import pycolmap
from splatmill_worker.images.decoding import decoders
from splatmill_worker.scene import Scene, View
from splatmill_worker.sfm import posed
from tests.support.files import program_files as written
from tests.support.files.program_files import PROGRAMS, SIZE, Float
from tests.support.posed_sets import ALL, COUNT, NAMES, check, loaded, model, photos, transforms, viewmat

VIEWMATS = [viewmat(k) for k in range(COUNT)]


def capture(folder: Path, program: str) -> Path:
    photos(folder / "images", size=SIZE)
    return PROGRAMS[program].write(folder, VIEWMATS, NAMES)


def rays() -> Float:
    """Points of a camera's frame all over its photo."""
    x, y = np.meshgrid(np.linspace(-0.55, 0.55, 9), np.linspace(-0.42, 0.42, 7))
    return np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1) * np.linspace(1, 5, x.size)[:, None]


def pixels(view: View, points: Float) -> Float:
    """Where points of a camera's frame fall on the photo, by COLMAP."""
    lens = view.lens
    if lens is None:
        own = view.camera
        camera = pycolmap.Camera(
            model="PINHOLE", width=own.width, height=own.height, params=[own.fx, own.fy, own.cx, own.cy]
        )
        scale = np.ones(2)
    else:
        camera = pycolmap.Camera(model=lens.model, width=lens.width, height=lens.height, params=lens.params)
        scale = np.array([view.camera.width / lens.width, view.camera.height / lens.height])
    return np.array([camera.img_from_cam(point) for point in points]) * scale


def check_lens(scene: Scene, project: Callable[[Float], Float]) -> None:
    points = rays()
    for view in scene.views:
        assert np.abs(pixels(view, points) - project(points)).max() < 0.01


@pytest.mark.parametrize("program", PROGRAMS)
def test_cameras_are_those_of_the_same_capture(tmp_path: Path, program: str) -> None:
    capture(tmp_path, program)
    scene = loaded(tmp_path)
    assert {view.name: view.image.name for view in scene.views} == {name: name for name in NAMES}
    for view in scene.views:
        np.testing.assert_allclose(view.camera.viewmat, viewmat(ALL[view.name]), atol=1e-6)
    check_lens(scene, PROGRAMS[program].project)
    assert (scene.source, scene.warnings[1:] if program == "OpenSfM" else scene.warnings) == ("program", ())
    if program in ("Bundler", "OpenSfM", "VisualSFM"):
        np.testing.assert_array_equal(scene.points[0], [1.5, 2.5, 3.5])
        np.testing.assert_array_equal(scene.colors[0], [10, 20, 30])


@pytest.mark.parametrize("program", PROGRAMS)
@pytest.mark.parametrize("place", ["", "set/scene/"])
def test_the_command_line_sends_them_and_the_decoders_read_them(
    tmp_path: Path, program: str, place: str
) -> None:
    """As files of a capture, in a process of its own; RealityScan's XMP files lie beside the photos."""
    source, stored = tmp_path / "given", tmp_path / "capture"
    folder = source / place
    folder.mkdir(parents=True)
    capture(folder, program)
    if program == "RealityScan, XMP":
        for path in list(folder.glob("*.xmp")):
            path.rename(folder / "images" / path.name)
    for file in find_files(source).files:
        target = stored / file.role / file.name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(file.path.read_bytes())
    with decoders.confined([stored]):
        scene = loaded(stored)
    assert len(scene.views) == COUNT
    for view in scene.views:
        np.testing.assert_allclose(view.camera.viewmat, viewmat(ALL[view.name.rpartition("/")[2]]), atol=1e-6)


@pytest.mark.parametrize("program", PROGRAMS)
@pytest.mark.parametrize("share", [0.6, 0.97])
def test_a_file_that_is_cut_off_is_named(tmp_path: Path, program: str, share: float) -> None:
    path = capture(tmp_path, program)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    if program == "RealityScan, XMP":
        for other in tmp_path.glob("*.xmp"):
            other.write_bytes(data[: int(share * len(data))])
    poses = posed.find(tmp_path)
    assert poses is not None
    with pytest.raises(ValueError, match=r"The file .* of .* (could not be read|cannot be used)"):
        poses.load()


MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])


@pytest.mark.parametrize("program", ["Metashape", "RealityScan, XMP", "Bundler", "3D Gaussian Splatting"])
def test_mirrored_axes_are_refused_and_one_of_many_is_left_out(tmp_path: Path, program: str) -> None:
    photos(tmp_path / "images", size=SIZE)
    PROGRAMS[program].write(tmp_path, [MIRROR @ each for each in VIEWMATS], NAMES)
    poses = posed.find(tmp_path)
    assert poses is not None
    with pytest.raises(ValueError, match="the determinant is -1"):
        poses.load()
    PROGRAMS[program].write(tmp_path, [MIRROR @ VIEWMATS[0], *VIEWMATS[1:]], NAMES)
    scene = loaded(tmp_path)
    assert [name for name, reason in scene.left_out if "determinant" in reason] == [NAMES[0]]
    assert len(scene.views) == COUNT - 1


def replaced(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


WRONG = {
    "f in pixels": ("RealityScan, CSV", ",29.0,", ",2900.0,", "if it is in pixels"),
    "a line of another length": ("RealityScan, CSV", ",29.0,", ",29,0,", "decimals are written with commas"),
    "f in millimetres": ("Metashape", "<f>512.0</f>", "<f>4.2</f>", "intrinsics are in pixels"),
    "skew": ("Metashape", "<k1>", "<b2>8.0</b2><k1>", "without b2"),
    "a panorama": ("Metashape", 'type="frame"', 'type="spherical"', "the type 'spherical'"),
    "entities": ("Metashape", "<document", "<!DOCTYPE a [<!ENTITY b 'c'>]><document", "a document type"),
    "a focal length in pixels": ("OpenSfM", '"focal_x": 0.83', '"focal_x": 830', "if it is in pixels"),
    "another projection": ("OpenSfM", '"brown"', '"spherical"', "the projection type"),
    "no camera": ("OpenSfM", '{"v2 a": {', '{"v2 b": {', "which is missing"),
    "another version": ("Bundler", "v0.3", "v0.4", "version 0.3 is read"),
    "f in parts of the photo": ("Bundler", "530.0 ", "0.83 ", "intrinsics are in pixels"),
    "no number": ("Bundler", "530.0 ", "5e400 ", "not finite"),
    "a calibration": ("VisualSFM", "NVM_V3 ", "NVM_V3 FixedK 9 4 9 3", "one calibration of all photos"),
    "f in millimetres, as of a lens": ("VisualSFM", "\t530.0 ", "\t4.2 ", "intrinsics are in pixels"),
    "a negative focal length": ("VisualSFM", "\t530.0 ", "\t-530.0 ", "its focal length is -530"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_wrong_files_are_refused_with_what_to_do(tmp_path: Path, wrong: str) -> None:
    program, old, new, said = WRONG[wrong]
    path = capture(tmp_path, program)
    replaced(path, old, new)
    poses = posed.find(tmp_path)
    assert poses is not None
    with pytest.raises(ValueError, match=said):
        poses.load()


def test_other_distortion_models_of_realityscan_are_refused(tmp_path: Path) -> None:
    capture(tmp_path, "RealityScan, XMP")
    for path in tmp_path.glob("*.xmp"):
        replaced(path, "brown4t2", "division")
    poses = posed.find(tmp_path)
    assert poses is not None
    with pytest.raises(ValueError, match="the distortion model is division"):
        poses.load()


def test_focal_lengths_of_realityscan_in_pixels_are_refused(tmp_path: Path) -> None:
    capture(tmp_path, "RealityScan, XMP")
    for path in tmp_path.glob("*.xmp"):
        replaced(path, 'FocalLength35mm="29.0"', 'FocalLength35mm="2900.0"')
    poses = posed.find(tmp_path)
    assert poses is not None
    with pytest.raises(ValueError, match="if it is in pixels"):
        poses.load()


def test_bundler_without_its_list_is_refused(tmp_path: Path) -> None:
    capture(tmp_path, "Bundler")
    (tmp_path / "list.txt").unlink()
    poses = posed.find(tmp_path)
    assert poses is not None
    with pytest.raises(ValueError, match=r"such as list\.txt, which is missing"):
        poses.load()


def test_metashape_with_a_fourth_coefficient_and_with_a_fisheye_lens(tmp_path: Path) -> None:
    value = written.METASHAPE | {"k4": 0.004}
    photos(tmp_path / "images", size=SIZE)
    written.metashape(tmp_path, VIEWMATS, NAMES, value)
    check_lens(loaded(tmp_path), lambda points: written.metashape_project(points, value))
    lens = {"f": 300.0, "cx": 4.0, "cy": -3.0, "k1": 0.05, "k2": -0.01, "p1": 0.001, "p2": -0.002}
    written.metashape(tmp_path, VIEWMATS, NAMES, lens, "fisheye")

    def project(points: Float) -> Float:
        radius = np.hypot(points[:, 0], points[:, 1])
        angle = np.arctan2(radius, points[:, 2]) / np.maximum(radius, 1e-12)
        flat = np.stack([points[:, 0] * angle, points[:, 1] * angle, np.ones(len(points))], axis=1)
        return written.metashape_project(flat, lens | {"b1": 0.0})

    check_lens(loaded(tmp_path), project)


def test_matrices_of_visualsfm(tmp_path: Path) -> None:
    photos(tmp_path / "images", size=SIZE)
    written.visualsfm(tmp_path, VIEWMATS, NAMES, matrix=True)
    check(loaded(tmp_path), ALL)


@pytest.mark.parametrize(("name", "each"), [("metadata.json", False), ("metadata", True)])
def test_record3d_names_its_photos_by_their_numbers(tmp_path: Path, name: str, each: bool) -> None:
    """As an export of photos, and as an unpacked .r3d."""
    numbered = [f"{k}.jpg" for k in range(COUNT)]
    photos(tmp_path / "rgbd", numbered, SIZE)
    written.record3d(tmp_path / name, VIEWMATS, each=each)
    scene = loaded(tmp_path)
    assert [(view.name, view.image.name) for view in scene.views] == [
        (f"rgbd/{each}", each) for each in sorted(numbered)
    ]
    for view in scene.views:
        np.testing.assert_allclose(view.camera.viewmat, viewmat(int(view.image.stem)), atol=1e-9)
        camera = view.camera
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx(written.RECORD3D)


def test_geocentric_cameras_are_moved_to_the_origin(tmp_path: Path) -> None:
    photos(tmp_path / "images", size=SIZE)
    far = np.eye(4)
    far[:3, 3] = [-3.9e6, -3.3e5, -5.0e6]
    written.metashape(tmp_path, [each @ far for each in VIEWMATS], NAMES)
    scene = loaded(tmp_path)
    centers = np.array([np.linalg.inv(each)[:3, 3] for each in VIEWMATS])
    expected = centers - centers.mean(axis=0)
    by_name = {view.name: view.camera.center for view in scene.views}
    assert max(np.abs(by_name[name] - expected[k]).max() for name, k in ALL.items()) < 1e-5
    assert any("moved to their mean" in note for note in scene.notes)


def test_two_files_of_one_program_are_named(tmp_path: Path) -> None:
    path = capture(tmp_path, "Metashape")
    (tmp_path / "again.xml").write_bytes(path.read_bytes())
    with pytest.raises(posed.TwoFiles, match=r"again\.xml and in cameras\.xml"):
        posed.find(tmp_path)


def test_of_several_programs_one_is_used_and_a_data_set_of_colmap_before_them(tmp_path: Path) -> None:
    for program in ("Bundler", "Metashape"):
        capture(tmp_path, program)
    said = "The cameras of Bundler in bundle.out are not used, but those in cameras.xml."
    assert loaded(tmp_path).warnings == (said,)
    transforms(tmp_path / "transforms.json")
    scene = loaded(tmp_path)
    assert scene.source == "transforms"
    assert (
        "The cameras of Metashape in cameras.xml are not used, but those in transforms.json."
        in scene.warnings
    )
    photos(tmp_path / "images")
    model(tmp_path / "sparse/0")
    check(loaded(tmp_path), ALL)


STRAY = {
    "notes.csv": b"name,weight\r\na,3\r\n",
    "a.xml": b"<gpx><trk/></gpx>",
    "nohup.out": b"started",
    "a.xmp": b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><crs:Exposure/></x:xmpmeta>',
    "reconstruction.json": b"{}",
    "wordlist.txt": b"a",
    "a.nvm": b"x",
    "cameras.json": b'{"cameras": [{"name": "a.jpg"}]}',
    "metadata.json": b'{"title": "an album"}',
}


def test_files_with_such_names_and_other_contents_are_no_cameras(tmp_path: Path) -> None:
    photos(tmp_path / "images")
    for name, content in STRAY.items():
        (tmp_path / name).write_bytes(content)
    assert posed.find(tmp_path) is None
    (tmp_path / "poses").mkdir()
    for name in STRAY:
        (tmp_path / name).rename(tmp_path / "poses" / name)
    (said,) = posed.without_cameras(tmp_path)
    assert said.startswith(
        "No cameras of a program that is known (Metashape, RealityScan, OpenSfM, Bundler, VisualSFM, "
        "3D Gaussian Splatting, Record3D) are in"
    )


UNREAD = [
    "scene.sfm",
    "poses_bounds.npy",
    "a.psx",
    "sfm_data.bin",
    "shots.geojson",
    "temple_par.txt",
    "00000001_cam.txt",
    "scan_calibrated_external_camera_parameters.txt",
    "cameras_sphere.npz",
    "intrinsics.txt",
    "pose/000.txt",
    "camera/000.json",
    "lowres_wide.traj",
    "frame_00000.json",
    "Barn_COLMAP_SfM.log",
    "poses.txt",
    "a.psz",
    "a.p4d",
]


@pytest.mark.parametrize("name", UNREAD)
def test_cameras_that_are_not_read_are_sent_so_that_the_job_names_them(tmp_path: Path, name: str) -> None:
    source, stored = tmp_path / "given", tmp_path / "capture"
    photos(source / "images")
    (source / name).parent.mkdir(exist_ok=True)
    (source / name).write_bytes(b"x")
    listing = find_files(source)
    assert any(name in remark and "are not read" in remark for remark in listing.remarks)
    for file in listing.files:
        target = stored / file.role / file.name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(file.path.read_bytes())
    assert posed.find(stored) is None
    assert [name in said and "are not read" in said for said in posed.without_cameras(stored)] == [True]
