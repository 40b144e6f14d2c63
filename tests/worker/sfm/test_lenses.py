"""Proves that a camera whose photos have two focal lengths is divided, and that one with a single one is not.

Does not prove that photos of two lenses can be mapped with one camera in the first place.
"""

import pytest

from splatmill_worker.sfm import lenses
from splatmill_worker.sfm.cameras import CameraGroup
from splatmill_worker.sfm.mapping.adjust import bundle_adjust
from tests.support.scenes.motions import FOCAL, HEIGHT, WIDTH, Motion, ball, circle, model_of

PHOTOS = tuple(range(36))


def group(known: bool = False) -> list[CameraGroup]:
    return [CameraGroup(PHOTOS, WIDTH, HEIGHT, 1.2, known)]


@pytest.mark.parametrize("ratio", [1.1, 1.5])
def test_two_focal_lengths_become_two_cameras(ratio: float) -> None:
    model = model_of(ball, FOCAL, focals=(FOCAL, FOCAL, FOCAL * ratio))
    bundle_adjust(model, 1, cancelled=lambda: False)
    longer = tuple(range(2, 36, 3))
    assert [group.photos for group in lenses.divided(group(), model)] == [
        tuple(photo for photo in PHOTOS if photo not in longer),
        longer,
    ]


@pytest.mark.parametrize("motion", [ball, circle(0.0)], ids=["ball", "level circle"])
def test_one_focal_length_stays_one_camera(motion: Motion) -> None:
    model = model_of(motion, 1.15 * FOCAL)
    bundle_adjust(model, 1, cancelled=lambda: False)
    assert lenses.divided(group(), model) == group()


def test_a_camera_of_exif_is_not_divided() -> None:
    model = model_of(ball, FOCAL, focals=(FOCAL, 1.5 * FOCAL))
    bundle_adjust(model, 1, cancelled=lambda: False)
    assert lenses.divided(group(known=True), model) == group(known=True)
