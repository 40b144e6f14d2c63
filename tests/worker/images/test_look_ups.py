"""Proves that look-ups of undistorted photos stay within their bound of memory, whatever the number of lenses, and that
they do not depend on how many positions are computed at a time.

Does not prove that they are right: the tests of undistortion in test_images do.
"""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatmill_worker.images import look_ups
from splatmill_worker.images.load import load_views
from splatmill_worker.scene import Camera, Lens, View

CAMERA = Camera(64, 48, 50.0, 50.0, 32.0, 24.0, np.eye(4))


def lens(number: int) -> Lens:
    return Lens("SIMPLE_RADIAL", (50.0, 32.0, 24.0, 0.01 * number), 64, 48)


@pytest.fixture(autouse=True)
def nothing_kept() -> None:
    look_ups.forget()


def test_a_lens_for_each_photo_stays_within_the_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    of_one = 2 * 2 * 64 * 48 * 8 + 64 * 48
    monkeypatch.setattr(look_ups, "KEPT_BYTES", 3 * of_one)
    for number in range(20):
        look_ups.of(lens(number), CAMERA, 2)
        assert look_ups.kept_bytes() == min(number + 1, 3) * of_one
    again = look_ups.of(lens(18), CAMERA, 2)
    assert look_ups.of(lens(18), CAMERA, 2) is again  # the one used last is kept
    monkeypatch.setattr(look_ups, "KEPT_BYTES", of_one // 2)
    assert look_ups.of(lens(30), CAMERA, 2) is look_ups.of(lens(30), CAMERA, 2)
    assert look_ups.kept_bytes() == of_one  # one that is larger than the bound, alone


@pytest.mark.parametrize("band", [1, 700, 10**6])
def test_positions_do_not_depend_on_the_size_of_a_band(band: int, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = look_ups.of(lens(40), CAMERA, 3)
    look_ups.forget()
    monkeypatch.setattr(look_ups, "BAND", band)
    grid, visible = look_ups.of(lens(40), CAMERA, 3)
    np.testing.assert_array_equal(grid, whole[0])
    np.testing.assert_array_equal(visible, whole[1])
    assert 0 < int(visible.sum()) < visible.numel()
    # The middle of the photo is the middle of the pinhole's, and all of a row is at its height but for the distortion.
    np.testing.assert_allclose(grid[71:73, 95:97].mean(dim=(0, 1)), 0.0, atol=1e-6)


def test_nothing_is_kept_once_the_photos_are_loaded(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    Image.new("RGB", (64, 48), (90, 120, 30)).save(path)
    views = [View(f"{number}.png", CAMERA, path, lens=lens(number)) for number in range(1, 4)]
    photos = load_views(views, 64, threads=2)
    assert [photo.rgb.shape for photo in photos] == [(48, 64, 3)] * 3
    assert look_ups.kept_bytes() == 0
