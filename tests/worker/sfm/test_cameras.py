"""Proves which photos share a camera, and that EXIF sets its initial focal length.

Does not prove that the shared focal length converges; `test_reconstruct` compares it with the truth.
"""

from dataclasses import replace

import numpy as np
import pytest

from splatmill_worker.images.image_circle import Circle
from splatmill_worker.sfm import cameras
from tests.support.scenes.photos import usable


def test_photos_that_agree_share_a_camera() -> None:
    phone = {"make": "A", "model": "B", "focal_in_diagonals": 0.6}
    groups = cameras.group([usable("1", **phone), usable("2"), usable("3", **phone), usable("4")])
    assert [group.photos for group in groups] == [(0, 2), (1, 3)]
    assert groups[0].known
    assert groups[0].focal == pytest.approx(0.6 * 800 / 640)
    assert not groups[1].known


def test_photos_without_exif_share_a_camera_within_their_folder_or_video() -> None:
    folders = [usable(f"{folder}/{number}.jpg") for folder in "ab" for number in range(3)]
    video = [replace(usable(f"walk_{number}.jpg"), sequence="walk.mp4") for number in range(3)]
    alone = [usable("one.jpg"), usable("c/two.jpg")]
    groups = cameras.group([*folders, *video, *alone])
    assert [group.photos for group in groups] == [(0, 1, 2), (3, 4, 5), (6, 7, 8), (9, 10)]


def test_photos_with_exif_share_a_camera_across_folders() -> None:
    tags = {"make": "A", "model": "B", "focal_in_diagonals": 0.6}
    groups = cameras.group([usable(f"{number}/photo.jpg", **tags) for number in range(8)])
    assert [group.photos for group in groups] == [tuple(range(8))]


def test_fisheyes_have_cameras_of_their_own() -> None:
    circle = Circle(0.52, 0.5, 0.4)
    phone = {"make": "A", "model": "B", "focal_in_diagonals": 0.6}
    plain, named = usable("1", **phone), usable("2", lens="8mm Fish-Eye", **phone)
    round_ones = [replace(usable(name, **phone), circle=circle) for name in ("3", "4")]
    groups = cameras.group([plain, named, *round_ones])
    assert [(group.photos, group.is_fisheye) for group in groups] == [
        ((0,), False),
        ((1,), True),
        ((2, 3), True),
    ]
    assert groups[1].focal == pytest.approx(400 / 640 / (np.pi / 2))
    assert groups[1].center == (0.5, 0.5)
    assert groups[2].focal == pytest.approx(0.4 / (np.pi / 2))
    assert groups[2].center == (0.52, 0.5)
    ordinary = cameras.as_pinholes(groups)
    assert ordinary[0] is groups[0]
    assert {(group.focal, group.known, group.is_fisheye) for group in ordinary[1:]} == {(1.2, False, False)}


def test_the_sensor_of_a_known_camera_gives_the_focal_length() -> None:
    # Of COLMAP's table; the sensor is 36 mm wide. The photo itself, which is not there, is not opened.
    tags = {"make": "Canon", "model": "Canon EOS 5D Mark II", "focal_length": 50.0}
    (group,) = cameras.group([usable("1", **tags)])
    assert group.known
    assert group.focal == pytest.approx(50.0 / 36.0)
    for wrong in (
        {"model": "not in the table"},
        {"make": None},
        {"focal_length": 1e300},
        {"focal_length": 1e-9},
    ):
        (unknown,) = cameras.group([usable("1", **tags | wrong)])
        assert not unknown.known
