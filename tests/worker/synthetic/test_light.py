"""Proves that planted light is what it says: exposures and tints drawn and spared, corners darker, surroundings evened.

Does not prove that any trainer recovers it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatmill_worker import synthetic
from splatmill_worker.synthetic import Light

GREY = np.full((90, 120, 3), 100, np.uint8)
ONE = np.ones(3)


def test_exposures_and_tints_are_drawn_but_for_held_out_photos() -> None:
    gains = Light(exposures=0.3, tints=0.1).gains(400)
    assert (gains[::8] == 1.0).all()
    drawn = np.log(np.delete(gains, np.arange(0, 400, 8), axis=0))
    # 350 draws: the standard deviation of their standard deviation is a twenty-sixth of it; four of those.
    assert drawn[:, 1].std() == pytest.approx(0.3, rel=0.16)
    assert (drawn[:, 0] - drawn[:, 1]).std() == pytest.approx(0.1, rel=0.16)
    assert np.abs(drawn.mean(axis=0)).max() < 1e-12
    assert (Light(exposures=0.3).gains(40)[:, 0] == Light(exposures=0.3).gains(40)[:, 2]).all()
    assert (Light().gains(9) == 1.0).all()


def test_a_camera_that_keeps_the_light_keeps_every_value() -> None:
    photo = np.random.default_rng(0).integers(0, 256, (30, 40, 3), dtype=np.uint8)
    assert (Light().falling_on(photo, ONE) == photo).all()
    assert (Light().falling_on(GREY, np.array([1.5, 1.0, 0.5]))[0, 0] == (150, 100, 50)).all()


def test_corners_lose_the_share_that_was_planted() -> None:
    dimmed = Light(vignetting=0.4).falling_on(GREY, ONE).astype(float)
    assert dimmed[45, 60, 0] == 100
    # The pixel's centre is half a pixel inside the corner.
    assert dimmed[0, 0, 0] == pytest.approx(60, abs=1.5)
    assert dimmed[45, 0, 0] == pytest.approx(100 * (1 - 0.4 * 0.64), abs=1.5)


def test_local_tone_mapping_evens_out_surroundings_and_keeps_detail() -> None:
    halves = GREY.copy()
    halves[:, 60:] = 50
    halves[10, 10] = 110
    toned = Light(tone=0.5).falling_on(halves, ONE).astype(float)
    # Far from the edge, half of the contrast of ln 2 is left.
    assert np.log(toned[60, 5, 0] / toned[60, 115, 0]) == pytest.approx(0.5 * np.log(2), abs=0.03)
    assert toned[10, 10, 0] / toned[10, 5, 0] == pytest.approx(1.1, abs=0.03)


def test_a_capture_has_the_planted_light(tmp_path: Path) -> None:
    plain, dark = tmp_path / "plain", tmp_path / "dark"
    synthetic.capture(plain, 3, 40, 30, samples=1)
    synthetic.capture(dark, 3, 40, 30, samples=1, light=Light(exposures=0.4))
    gains = Light(exposures=0.4).gains(3)
    for number, path in enumerate(sorted(plain.iterdir())):
        with Image.open(path) as one, Image.open(dark / path.name) as other:
            before, after = (np.asarray(photo, dtype=float) for photo in (one, other))
            assert other.getexif()[0x0110] == "Ray caster"
        unclipped = (before > 20) & (before < 150)
        ratio = np.median(after[unclipped] / before[unclipped])
        assert ratio == pytest.approx(gains[number, 0], rel=0.03)
