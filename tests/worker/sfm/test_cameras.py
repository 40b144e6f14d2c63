"""Proves which photos share a camera, and that EXIF sets its initial focal length.

Does not prove that the shared focal length converges; `test_reconstruct` compares it with the truth.
"""

import pytest

from splatmill_worker.sfm import cameras
from tests.support.photos import usable


def test_photos_that_agree_share_a_camera() -> None:
    phone = {"make": "A", "model": "B", "focal_in_diagonals": 0.6}
    groups = cameras.group([usable("1", **phone), usable("2"), usable("3", **phone), usable("4")])
    assert [group.photos for group in groups] == [(0, 2), (1, 3)]
    assert groups[0].known
    assert groups[0].focal == pytest.approx(0.6 * 800 / 640)
    assert not groups[1].known
