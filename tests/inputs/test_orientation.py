"""Photos that are stored upside down, with cameras of the upright ones, are read upright, as the matches decide.

Does not prove other orientations; tests/worker/sfm/posed/test_orientation.py does.
"""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image, ImageOps

from splatmill_worker.images.load import load_view
from splatmill_worker.sfm import posed
from splatmill_worker.sfm.posed.judged import orientation
from tests.inputs.conftest import Build


@pytest.mark.slow
def test_photos_stored_upside_down_are_read_as_their_cameras_saw_them(built: Build) -> None:
    poses = posed.find(built("orientation-180"))
    assert poses is not None
    scene = poses.load()
    assert sum(view.other is not None for view in scene.views) == 15
    scene = orientation.decided(scene)
    assert len(scene.views) == 30
    for view in scene.views:
        assert view.other is None
        with Image.open(view.image) as photo:
            upright = np.asarray(ImageOps.exif_transpose(photo).convert("RGB"))
        np.testing.assert_array_equal(load_view(view, max(upright.shape)).rgb, upright)
    (warning,) = scene.warnings
    assert warning.endswith(f"so the photos are read {orientation.READINGS[True]}.")
