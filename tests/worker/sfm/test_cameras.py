"""Proves which photos share a camera, and that EXIF sets its initial focal length.

Does not prove that the shared focal length converges; `test_reconstruct` compares it with the truth.
"""

from dataclasses import replace

import pytest

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
