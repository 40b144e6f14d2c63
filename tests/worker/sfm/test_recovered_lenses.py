"""Proves that photos without EXIF give each camera its true focal length: on a level circle, and of two phones.

The photos are generated, so that the lenses are known. Does not prove the same for lenses with strong distortion, or
for two phones in one folder, whose division `test_lenses` proves on models.
"""

import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatmill_worker import sfm
from splatmill_worker.scene import Scene
from splatmill_worker.synthetic.ray_caster import look_at, picture, still_life

pytestmark = pytest.mark.slow

WIDTH, HEIGHT = 384, 288


def photograph(path: Path, angle: float, pitch: float, focal: float) -> None:
    eye = 3.7 * np.array(
        [math.cos(angle) * math.cos(pitch), math.sin(angle) * math.cos(pitch), math.sin(pitch)]
    )
    camera = look_at(eye, np.array([0, 0, 0.25]), WIDTH, HEIGHT, focal)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture(still_life(0), camera, 1)).save(path)


def reconstruct(folder: Path) -> Scene:
    # One effort places all photos; what others add is in test_effort.
    options = sfm.SfmOptions(effort="standard", stereo=False)
    return sfm.reconstruct(folder / "images", None, folder / "work", options, lambda *_: None, lambda: False)


def test_a_level_circle_has_square_pixels(tmp_path: Path) -> None:
    for number in range(16):
        photograph(tmp_path / f"images/{number:02d}.png", 0.75 * 2 * math.pi * number / 16, 0.5, 315.0)
    scene = reconstruct(tmp_path)
    assert len(scene.views) == 16
    camera = scene.views[0].camera
    assert camera.fx == camera.fy == pytest.approx(315, rel=0.01)
    assert any("assumed to be square" in note for note in scene.notes)


def test_two_phones_with_a_folder_each_have_two_focal_lengths(tmp_path: Path) -> None:
    true = {}
    for number in range(28):
        folder, focal = ("a", 250.0) if number % 2 else ("b", 400.0)
        name = f"{folder}/{number:02d}.png"
        pitch = 0.35 + 0.25 * math.sin(1.7 * number)
        photograph(tmp_path / "images" / name, 2 * math.pi * number / 28, pitch, focal)
        true[name] = focal
    scene = reconstruct(tmp_path)
    assert len(scene.views) == 28
    for view in scene.views:
        assert view.camera.fx == pytest.approx(true[view.name], rel=0.02)
