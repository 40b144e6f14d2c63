"""Proves that planted movers stand in the photos that they are said to, nowhere else, and that their pixels are known.

Does not prove that any trainer finds them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from splatmill_worker import synthetic
from splatmill_worker.synthetic import Movers
from splatmill_worker.synthetic.movers import CHANGED, changed


def test_movers_spare_the_photos_that_are_held_out() -> None:
    passing = Movers(share=1.0, each=3).passing(20)
    assert [len(things) for things in passing] == [0 if number % 8 == 0 else 3 for number in range(20)]
    assert not any(Movers(share=0.0).passing(20))
    some = sum(map(bool, Movers(share=0.4).passing(400)))
    # 350 draws of 0.4: 140, with a standard deviation of nine; four of those.
    assert 104 < some < 176


def test_each_time_things_are_somewhere_else_and_the_same_seed_gives_the_same() -> None:
    first, again = (Movers(share=1.0, each=1).passing(9) for _ in range(2))
    centers = [things[0].center for things in first[1:8]]
    assert len(set(centers)) == 7
    assert centers == [things[0].center for things in again[1:8]]


def test_what_changes_less_than_that_is_no_mover() -> None:
    grey = np.full((2, 3, 3), 100, np.uint8)
    other = grey.copy()
    other[0, 0, 1] += CHANGED
    other[1, 2, 2] -= CHANGED + 1
    assert changed(other, grey).tolist() == [[False, False, False], [False, False, True]]


def test_a_capture_has_the_movers_and_their_pixels(tmp_path: Path) -> None:
    plain, busy, truth = tmp_path / "plain", tmp_path / "busy", tmp_path / "truth"
    synthetic.capture(plain, 3, 64, 48, samples=1)
    synthetic.capture(busy, 3, 64, 48, samples=1, movers=Movers(share=1.0), truth=truth)
    names = sorted(path.name for path in plain.iterdir())
    assert sorted(path.stem for path in truth.iterdir()) == [Path(name).stem for name in names[1:]]
    assert (plain / names[0]).read_bytes() == (busy / names[0]).read_bytes()
    for name in names[1:]:
        with (
            Image.open(plain / name) as one,
            Image.open(busy / name) as other,
            Image.open(truth / Path(name).with_suffix(".png")) as marks,
        ):
            before, after = (np.asarray(photo, dtype=float) for photo in (one, other))
            moved = np.asarray(marks)
        assert 0.01 < moved.mean() < 0.7
        # JPEG spreads an edge over a block of 16 pixels, so that only means over the two parts are told apart.
        apart = np.abs(after - before).mean(axis=2)
        assert apart[moved].mean() > 10 * apart[~moved].mean()
