"""Proves which camera models are read, in transforms.json and in COLMAP models; and that others are refused by name,
with what is read and what to do.

Does not prove how lenses are undistorted: tests/worker/images/test_lens.py does, and test_faces.py for panoramas.
"""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatmill.schema import TrainOptions
from splatmill_worker.errors import Refusal
from splatmill_worker.images.panoramas import faces
from splatmill_worker.pipeline.capture import posed_scene
from splatmill_worker.scene import Lens, Scene
from splatmill_worker.sfm.posed import camera_models
from tests.support import posed_sets
from tests.support.posed_sets import COUNT, NAMES, frames, loaded


def transforms(folder: Path, per_frame: dict[int, dict[str, Any]] | None = None, **values: Any) -> Path:
    """A capture whose transforms.json has these fields, and others in single frames."""
    posed_sets.photos(folder / "images")
    listed = [frame | (per_frame or {}).get(index, {}) for index, frame in enumerate(frames())]
    document = {"w": 64, "h": 48, "fl_x": 60, "fl_y": 61, "cx": 32, "cy": 24, **values, "frames": listed}
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder


def refused(capture: Path, work: Path) -> Refusal:
    with pytest.raises(Refusal) as error:
        posed_scene(capture, work, TrainOptions(), lambda *_: None, lambda: False)
    assert error.value.code == "poses_invalid"
    return error.value


def lens_of(scene: Scene) -> Lens | None:
    (own,) = {view.lens for view in scene.views}
    return own


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ({"camera_model": "VR180_L"}, "VR180_L"),
        ({"camera_model": "OMNIDIRECTIONALSTEREO_R"}, "OMNIDIRECTIONALSTEREO_R"),
        ({"latlong": True}, "LATLONG"),
        ({"equirectangular": True}, "EQUIRECTANGULAR_EQUAL_AREA"),
        ({"camera_model": "ORTHOPHOTO"}, "ORTHOPHOTO"),
        ({"camera_model": "FISHEYE624"}, "FISHEYE624"),
        ({"camera_model": "THIN_PRISM_FISHEYE"}, "THIN_PRISM_FISHEYE"),
        ({"ftheta_p0": 0.1}, "FTHETA"),
        ({"camera_model": 7}, "7"),
    ],
)
def test_models_that_are_not_read_are_refused_by_name(
    tmp_path: Path, values: dict[str, Any], name: str
) -> None:
    error = refused(transforms(tmp_path / "all", **values), tmp_path)
    assert f"Frame 0 of transforms.json (images/{NAMES[0]}): the camera model is {name}" in error.message
    assert "OPENCV_FISHEYE" in error.message
    assert error.advice is not None
    panoramic = camera_models.is_panoramic(name)
    assert ("faces of a cube" in error.advice) == panoramic
    assert ("recovered" in error.advice) != panoramic
    of_frames = transforms(tmp_path / "frames", dict.fromkeys(range(COUNT), values))
    assert refused(of_frames, tmp_path).message == error.message


def test_one_frame_of_a_model_that_is_not_read_is_left_out(tmp_path: Path) -> None:
    scene = loaded(transforms(tmp_path, {3: {"camera_model": "CYLINDRICAL"}}))
    assert len(scene.views) == COUNT - 1
    ((name, why),) = scene.left_out
    assert name == NAMES[3]
    assert "the camera model is CYLINDRICAL" in why


@pytest.mark.parametrize(
    ("values", "model", "extra"),
    [
        ({}, None, ()),
        ({"camera_model": None}, None, ()),
        ({"camera_model": "Pinhole"}, None, ()),
        ({"camera_model": "SIMPLE_RADIAL", "k1": 0.1}, "OPENCV", (0.1, 0.0, 0.0, 0.0)),
        ({"camera_model": "OPENCV", "k1": 0.1, "p2": 0.01}, "OPENCV", (0.1, 0.0, 0.0, 0.01)),
        ({"k3": 0.1}, "FULL_OPENCV", (0.0, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0)),
        (
            {"camera_model": "FULL_OPENCV", "k1": 0.1, "k6": 0.2},
            "FULL_OPENCV",
            (0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.2),
        ),
        ({"camera_model": "OPENCV_FISHEYE", "k4": 0.1}, "OPENCV_FISHEYE", (0.0, 0.0, 0.0, 0.1)),
        ({"camera_model": "RADIAL_FISHEYE", "k2": 0.1}, "OPENCV_FISHEYE", (0.0, 0.1, 0.0, 0.0)),
        ({"is_fisheye": True}, "OPENCV_FISHEYE", (0.0, 0.0, 0.0, 0.0)),
        ({"is_fisheye": False, "latlong": False}, None, ()),
    ],
)
def test_models_that_are_read(
    tmp_path: Path, values: dict[str, Any], model: str | None, extra: tuple[float, ...]
) -> None:
    own = lens_of(loaded(transforms(tmp_path, **values)))
    assert (None if own is None else own.model) == model
    assert (() if own is None else own.params[4:]) == extra


def colmap(capture: Path, form: str, name: str, number: int, size: tuple[int, int]) -> Path:
    """A data set with a COLMAP model of a camera with two parameters, the sides of the photo."""
    posed_sets.photos(capture / "images", size=size)
    folder = capture / "sparse/0"
    posed_sets.model(folder)
    if form == "text":
        (folder / "cameras.txt").write_text(f"1 {name} {size[0]} {size[1]} {size[0]} {size[1]}\n")
        return capture
    for stem in ("cameras", "images", "points3D"):
        (folder / f"{stem}.txt").unlink()
    (folder / "cameras.bin").write_bytes(struct.pack("<QIiQQ2d", 1, 1, number, *size, *map(float, size)))
    image = struct.pack("<I7dI", 1, 1, 0, 0, 0, 0, 0, 0, 1) + NAMES[0].encode() + b"\0" + struct.pack("<Q", 0)
    (folder / "images.bin").write_bytes(struct.pack("<Q", 1) + image)
    return capture


@pytest.mark.parametrize(("form", "name"), [("text", "POLAROID"), ("binary", "99")])
def test_colmap_models_that_are_not_read_are_refused_by_name(tmp_path: Path, form: str, name: str) -> None:
    error = refused(colmap(tmp_path / "capture", form, name, 99, (64, 48)), tmp_path)
    assert "THIN_PRISM_FISHEYE" in error.message  # one of those that are read
    assert name in error.message
    assert error.advice is not None


@pytest.mark.parametrize("form", ["text", "binary"])
def test_panoramas_of_colmap_models_are_read(tmp_path: Path, form: str) -> None:
    scene = loaded(colmap(tmp_path, form, "EQUIRECTANGULAR", 17, (64, 32)))
    assert lens_of(scene) == Lens("EQUIRECTANGULAR", (64.0, 32.0), 64, 32)


@pytest.mark.parametrize("name", ["EQUIRECTANGULAR", "equirectangular"])
def test_panoramas_of_transforms_are_read_and_keep_their_pose(tmp_path: Path, name: str) -> None:
    capture = transforms(tmp_path, camera_model=name, w=64, h=32)
    posed_sets.photos(capture / "images", size=(64, 32))
    scene = faces.cut(loaded(capture))
    assert len(scene.views) == 6 * COUNT
    fronts = [view for view in scene.views if view.name.endswith("/front")]
    for number, view in enumerate(fronts):
        np.testing.assert_allclose(view.camera.viewmat, posed_sets.viewmat(number), atol=1e-12)
    assert [view.photo for view in fronts] == NAMES


def test_panoramas_that_are_not_twice_as_wide_as_high_are_refused(tmp_path: Path) -> None:
    """Both readings are named: a part of a panorama, and another lens."""
    for capture in (
        transforms(tmp_path / "a", camera_model="EQUIRECTANGULAR"),
        colmap(tmp_path / "b", "text", "EQUIRECTANGULAR", 17, (64, 48)),
    ):
        message = refused(capture, tmp_path).message
        assert "EQUIRECTANGULAR, and the photo has 64 x 48 pixels" in message
        assert "part of a panorama" in message
        assert "another lens" in message
