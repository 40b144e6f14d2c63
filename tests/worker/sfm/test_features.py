"""Proves that a search for features that was stopped continues where it was, and what COLMAP's database then holds."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatmill_worker import synthetic
from splatmill_worker.colmap import pycolmap
from splatmill_worker.errors import Cancelled
from splatmill_worker.images.prepare import prepare
from splatmill_worker.sfm import cameras, features
from splatmill_worker.sfm.options import LEAN

COUNT, BLANK = 6, 3


class Searches:
    """Searches the photos of a folder into a database, and is cancelled after some of them."""

    def __init__(self, folder: Path) -> None:
        prepared = prepare(folder / "images", None, folder / "work")
        self.photos, self.groups = prepared.photos, cameras.group(prepared.photos)
        self.searched = 0

    def run(self, path: Path, most: int = COUNT) -> None:
        done: list[int] = []

        def cancelled() -> bool:
            self.searched += len(done) < most
            return len(done) >= most

        with ThreadPoolExecutor(1) as pool:
            features.extract(
                self.photos, self.groups, LEAN, "SIMPLE_RADIAL", path, pool,
                lambda _stage, now, _total, _note: done.append(now), cancelled,
            )  # fmt: skip


@pytest.fixture
def searches(tmp_path: Path) -> Searches:
    synthetic.capture(tmp_path / "images", COUNT, 160, 120, samples=1)
    names = sorted((tmp_path / "images").iterdir())
    Image.new("RGB", (160, 120), (90, 90, 90)).save(names[BLANK])
    return Searches(tmp_path)


def test_photos_that_were_searched_are_not_searched_again(searches: Searches, tmp_path: Path) -> None:
    searches.run(tmp_path / "whole" / "database.db")
    assert searches.searched == COUNT
    part = tmp_path / "part" / "database.db"
    with pytest.raises(Cancelled):
        searches.run(part, 2)
    searches.searched = 0
    searches.run(part)
    assert searches.searched < COUNT
    searches.searched = 0
    searches.run(part)
    assert searches.searched == 0
    whole, again = (pycolmap.Database.open(path) for path in (tmp_path / "whole" / "database.db", part))
    try:
        (ids, first), (same, second) = features.load(whole), features.load(again)
        assert again.num_cameras() == len(searches.groups)
        assert again.read_camera(1) == whole.read_camera(1)
    finally:
        whole.close()
        again.close()
    assert ids == same == {index: index + 1 for index in range(COUNT)}
    for index, (one, other) in enumerate(zip(first, second, strict=True)):
        np.testing.assert_array_equal(one.points, other.points)
        np.testing.assert_array_equal(one.scales, other.scales)
        np.testing.assert_array_equal(one.descriptors, other.descriptors)
        assert (len(one.scales) == 0) == (index == BLANK)
