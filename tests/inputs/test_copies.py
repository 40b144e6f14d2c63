"""Photos that lie beside smaller copies of themselves are used without these; real captures have no copies.

Does not prove what counts as a copy; tests/worker/images/test_copies.py does.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest
from PIL import Image

from splatmill_worker.images.copies import SmallPicture, copies, is_copy, small_grey
from splatmill_worker.images.prepare import prepare
from splatmill_worker.pipeline.holdout.near_copies import same_photos
from splatmill_worker.sfm import posed
from tests.inputs.conftest import Build
from tests.support.paths import DATA


@pytest.mark.slow
def test_resized_copies_are_left_out_and_named(built: Build, tmp_path: Path) -> None:
    prepared = prepare(built("copies"), None, tmp_path)
    names = [f"still_{k:04d}.jpg" for k in range(1, 31)]
    assert [photo.name for photo in prepared.photos] == names
    assert dict(prepared.skipped) == {f"web/{name}": f"it shows the same as {name}" for name in names}
    assert any("30 photos show the same as another one" in warning for warning in prepared.warnings)


@pytest.mark.parametrize(
    ("capture", "count"), [("beer_720", 71), ("fox_540x960", 50), ("snowmiku_1008", 97), ("room_464", 60)]
)
def test_no_photo_of_a_walk_is_a_copy_by_its_content(capture: str, count: int) -> None:
    """room_464 is a slow walk with auto-exposure: its neighbouring frames are compared too."""
    if not (DATA / capture).is_dir():
        pytest.skip(f"{DATA / capture} is not here.")
    small = []
    for path in sorted((DATA / capture / "images").glob("*.jpg"))[:count]:
        with Image.open(path) as photo:
            small.append(SmallPicture(path.name, *photo.size, small_grey(photo.convert("RGB"))))
    assert len(small) == count
    assert copies(small) == {}
    assert [one.name for one, two in pairwise(small) if is_copy(one, two)] == []


@pytest.mark.parametrize(("capture", "count"), [("beer_720", 71), ("fox_540x960", 50)])
def test_no_photo_of_a_walk_with_cameras_is_a_copy(capture: str, count: int) -> None:
    if not (DATA / capture).is_dir():
        pytest.skip(f"{DATA / capture} is not here.")
    poses = posed.find(DATA / capture)
    assert poses is not None
    scene = poses.load()
    assert len(scene.views) == count
    assert same_photos(scene) == {}
