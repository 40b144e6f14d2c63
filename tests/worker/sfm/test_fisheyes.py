"""Proves that the cameras of photos of fisheye lenses are recovered: of circular ones, known by their dark frame, and
of full-frame ones, known by their EXIF; that what they see is divided among faces; and that round pictures of ordinary
lenses are placed, too.

The still life in a room is photographed by the ray caster, whose cameras are the truth.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatmill_worker.images.panoramas.faces import joined
from splatmill_worker.scene import Float, Scene
from splatmill_worker.sfm import SfmOptions, reconstruct
from splatmill_worker.synthetic import look_at
from splatmill_worker.synthetic.ray_caster import picture
from tests.support import panoramas
from tests.worker.sfm.test_panoramas import errors

pytestmark = pytest.mark.slow

COUNT, SIDE = 9, 480


def recovered(images: Path, work: Path) -> Scene:
    return reconstruct(images, None, work, SfmOptions(stereo=False), lambda *_: None, lambda: False)


def angle_between(scene: Scene, near: float) -> float:
    """Degrees that the recovered lens puts a pixel from its axis that lies as far as `near` radians by the first focal
    length."""
    lens = joined(scene).views[0].lens
    assert lens is not None
    assert "FISHEYE" in lens.model
    focal, extra = lens.params[0], lens.params[-4:] if len(lens.params) == 8 else lens.params[-1:]
    angles = np.linspace(0.0, np.pi / 2, 2000)
    places = focal * angles * (1.0 + sum(k * angles ** (2 * order) for order, k in enumerate(extra, 1)))
    return float(np.degrees(np.interp(near, places, angles)))


def recovered_as_taken(folder: Path, truth: dict[str, Float], focal: float) -> Scene:
    """The scene of COUNT photos, whose cameras and lens are those that took them."""
    scene = recovered(folder / "images", folder / "work")
    assert scene.facts["registered"] == COUNT
    angle, distance = errors(scene, truth)
    assert angle < 0.5
    assert distance < 0.02
    assert angle_between(scene, focal * 1.2) == pytest.approx(np.degrees(1.2), abs=0.3)
    return scene


def test_cameras_of_circular_fisheyes_are_recovered(tmp_path: Path) -> None:
    focal = SIDE / 2 / np.radians(185.0 / 2)
    truth = {f"{number}.jpg": pose for number, pose in enumerate(panoramas.walk(COUNT))}
    (tmp_path / "images").mkdir()
    for name, pose in truth.items():
        pixels = panoramas.fisheye(panoramas.room(), pose, (SIDE, SIDE), focal, 185.0, 1)
        Image.fromarray(pixels).save(tmp_path / "images" / name, quality=95, subsampling=0)
    scene = recovered_as_taken(tmp_path, truth, focal)
    assert {view.name.split("/")[1] for view in scene.views} == {"front", "right", "left", "up", "down"}
    assert all(view.mask is not None for view in scene.views)
    assert len(scene.overlays[0].photos) == COUNT
    assert any("round a circle, is dark in 9 photos" in said for said in scene.warnings)
    assert any("9 photos are taken for those of a fisheye lens" in said for said in scene.notes)


def test_cameras_of_full_frame_fisheyes_are_recovered_by_the_name_of_their_lens(tmp_path: Path) -> None:
    width, height = 640, 480
    focal = 400.0 / np.radians(90.0)
    truth = {f"{number}.jpg": pose for number, pose in enumerate(panoramas.walk(COUNT))}
    (tmp_path / "images").mkdir()
    for name, pose in truth.items():
        pixels = panoramas.fisheye(panoramas.room(), pose, (width, height), focal, 200.0, 1)
        exif = Image.Exif()
        exif[0x010F], exif[0x0110] = "Maker", "Body"
        exif.get_ifd(0x8769)[0xA434] = "15mm F2.8 Diagonal FISHEYE"
        Image.fromarray(pixels).save(tmp_path / "images" / name, quality=95, subsampling=0, exif=exif)
    recovered_as_taken(tmp_path, truth, focal)


def round_pictures(images: Path, focal: float, count: int, step: float, samples: int = 1) -> dict[str, Float]:
    """Photos of an ordinary lens in a round frame, `step` radians apart; their poses by name."""
    images.mkdir()
    truth = {}
    rows, columns = np.mgrid[:360, :480]
    outside = np.hypot(columns - 240, rows - 180) > 178
    for number in range(count):
        angle = step * number
        eye = 2.6 * np.array([np.cos(angle), np.sin(angle), 0.35])
        camera = look_at(eye, np.array([0.0, 0.0, 0.2]), 480, 360, focal)
        pixels = picture(panoramas.room(), camera, samples)
        pixels[outside] = 0
        name = f"{number}.jpg"
        Image.fromarray(pixels).save(images / name, quality=95, subsampling=0)
        truth[name] = camera.viewmat
    return truth


def test_round_pictures_of_an_ordinary_lens_have_its_angle(tmp_path: Path) -> None:
    truth = round_pictures(tmp_path / "images", 480.0, 6, 0.25)
    scene = recovered(tmp_path / "images", tmp_path / "work")
    assert scene.facts["registered"] == 6
    assert all(view.face is None for view in scene.views)
    angle, distance = errors(scene, truth)
    assert angle < 1.0
    assert distance < 0.05


def test_where_more_are_placed_as_photos_of_an_ordinary_lens_they_are_taken_for_those(tmp_path: Path) -> None:
    """An eighth of the angle of a fisheye, as of a microscope. Does not prove that such photos are placed well."""
    round_pictures(tmp_path / "images", 1000.0, 8, 0.2, samples=2)
    scene = recovered(tmp_path / "images", tmp_path / "work")
    assert any(said.startswith("As photos of a fisheye lens, 0 of 8 were placed") for said in scene.notes)
    assert not any("taken for those of a fisheye lens, by" in said for said in scene.notes)
    assert not any(view.lens is not None and "FISHEYE" in view.lens.model for view in scene.views)
