"""Masks as other programs name and draw them are used, counted and measured, and questioned where they hide most.

Does not prove that hidden pixels stay out of the training; the tests of loading photos do.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from splatmill.schema import Role
from splatmill.transfer.local_capture import find_files
from splatmill_worker.images.prepare import prepare
from splatmill_worker.sfm import posed
from tests.inputs.conftest import Build

pytestmark = pytest.mark.slow

HIDDEN = "30 of 30 photos have a mask; the masks hide 21% of their pixels."
"""240 of 360 rows of 150 of 480 columns are black."""


@pytest.mark.parametrize("kind", ["masks-unmatched", "masks-beside odm", "masks-beside mvs"])
def test_masks_of_other_programs_are_used_and_measured(built: Build, tmp_path: Path, kind: str) -> None:
    folder = built(*kind.split())
    masks = folder / "masks"
    prepared = prepare(folder / "images", masks if masks.is_dir() else None, tmp_path)
    assert len(prepared.photos) == 30
    assert len({photo.mask for photo in prepared.photos} - {None}) == 30
    assert (prepared.skipped, prepared.notes, prepared.warnings) == ((), (HIDDEN,), ())
    upload = find_files(folder)
    assert (upload.count(Role.images), upload.count(Role.masks), upload.ignored) == (30, 30, ())


def test_masks_whose_white_hides_are_questioned(built: Build) -> None:
    poses = posed.find(built("picture-kinds") / "inverted")
    assert poses is not None
    scene = poses.load()
    assert all(view.mask is not None for view in scene.views)
    (warning,) = scene.warnings
    assert "hide 91% of their pixels" in warning
    assert "invert them" in warning
