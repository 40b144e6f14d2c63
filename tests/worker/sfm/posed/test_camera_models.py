"""Proves which camera models are read, in transforms.json and in COLMAP models; that others are refused by name, with
what is read and what to do; and the warning about panoramas without cameras.

Does not prove how lenses are undistorted: tests/worker/images/test_lens.py does.
"""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatmill.schema import TrainOptions
from splatmill_worker.errors import Refusal, SfmFailed
from splatmill_worker.images.prepare import prepare
from splatmill_worker.pipeline.capture import posed_scene
from splatmill_worker.scene import Lens, Scene
from splatmill_worker.sfm import SfmOptions, reconstruct
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
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR"),
        ({"camera_model": "equirectangular"}, "equirectangular"),
        ({"camera_model": "VR180_L"}, "VR180_L"),
        ({"camera_model": "OMNIDIRECTIONALSTEREO_R"}, "OMNIDIRECTIONALSTEREO_R"),
        ({"latlong": True}, "LATLONG"),
        ({"equirectangular": True}, "EQUIRECTANGULAR"),
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
    scene = loaded(transforms(tmp_path, {3: {"camera_model": "EQUIRECTANGULAR"}}))
    assert len(scene.views) == COUNT - 1
    ((name, why),) = scene.left_out
    assert name == NAMES[3]
    assert "the camera model is EQUIRECTANGULAR" in why


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


@pytest.mark.parametrize("form", ["text", "binary"])
@pytest.mark.parametrize("name", ["EQUIRECTANGULAR", "POLAROID"])
def test_colmap_models_that_are_not_read_are_refused_by_name(tmp_path: Path, form: str, name: str) -> None:
    capture = tmp_path / "capture"
    posed_sets.photos(capture / "images")
    folder = capture / "sparse/0"
    posed_sets.model(folder)
    if form == "text":
        (folder / "cameras.txt").write_text(f"1 {name} 64 48 64 48\n")
    else:
        for stem in ("cameras", "images", "points3D"):
            (folder / f"{stem}.txt").unlink()
        number = {"EQUIRECTANGULAR": 17, "POLAROID": 99}[name]
        (folder / "cameras.bin").write_bytes(struct.pack("<QIiQQ2d", 1, 1, number, 64, 48, 64.0, 48.0))
        image = (
            struct.pack("<I7dI", 1, 1, 0, 0, 0, 0, 0, 0, 1) + NAMES[0].encode() + b"\0" + struct.pack("<Q", 0)
        )
        (folder / "images.bin").write_bytes(struct.pack("<Q", 1) + image)
    error = refused(capture, tmp_path)
    assert "THIN_PRISM_FISHEYE" in error.message  # one of those that are read
    assert (name if form == "text" or name == "EQUIRECTANGULAR" else "99") in error.message
    assert error.advice is not None
    assert ("faces of a cube" in error.advice) == (name == "EQUIRECTANGULAR")


def panorama(path: Path, xmp: str | None = None, seed: int = 0) -> None:
    """A sphere with stripes, 512 x 256 pixels."""
    longitude, latitude = np.meshgrid(
        (np.arange(512) + 0.5) / 512 * 2 * np.pi, (0.5 - (np.arange(256) + 0.5) / 256) * np.pi
    )
    x, y, z = np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)
    grey = 128 + 50 * np.sin(9 * x + seed) + 50 * np.sin(7 * y + 5 * z)
    path.parent.mkdir(parents=True, exist_ok=True)
    options: dict[str, Any] = {} if xmp is None else {"xmp": xmp.encode()}
    Image.fromarray(grey.astype(np.uint8)).convert("RGB").save(path, quality=95, **options)


GPANO = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF><rdf:Description '
    'xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" {}/></rdf:RDF></x:xmpmeta>'
)


@pytest.mark.parametrize(
    "field",
    [
        'GPano:ProjectionType="equirectangular"',
        "><GPano:ProjectionType>equirectangular</GPano:ProjectionType",
    ],
)
def test_panoramas_by_their_xmp_are_left_out_and_said(tmp_path: Path, field: str) -> None:
    for number in range(3):
        panorama(tmp_path / "images" / f"{number}.jpg", GPANO.format(field), number)
    with pytest.raises(SfmFailed, match="it is a panorama \\(equirectangular by its XMP\\)") as error:
        reconstruct(
            tmp_path / "images", None, tmp_path / "work", SfmOptions(), lambda *_: None, lambda: False
        )
    assert error.value.code == "no_images"
    Image.new("RGB", (512, 256), (9, 99, 99)).save(tmp_path / "images" / "plain.jpg")
    prepared = prepare(tmp_path / "images", None, tmp_path / "work")
    assert [photo.name for photo in prepared.photos] == ["plain.jpg"]
    assert all("faces of a cube" in why for _, why in prepared.skipped)


def test_pictures_with_the_edges_of_a_panorama_are_questioned(tmp_path: Path) -> None:
    for number in range(2):
        panorama(tmp_path / "images" / f"{number}.jpg", None, number)
    random = np.random.default_rng(0)
    for number in range(2):  # as wide, but a photo
        pixels = random.integers(0, 256, (16, 32, 3), np.uint8)
        Image.fromarray(pixels).resize((512, 256)).save(tmp_path / "images" / f"photo{number}.jpg")
    prepared = prepare(tmp_path / "images", None, tmp_path / "work")
    assert len(prepared.photos) == 4
    (warning,) = prepared.warnings
    assert warning.startswith("2 photos are twice as wide as high with edges that meet")
    assert "(such as 0.jpg)" in warning
