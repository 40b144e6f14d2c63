"""Proves which photos are set aside: spread over the capture, and some are always left to train on.

Does not prove that so few photos decide well; worker/bench/decisions.md has what was measured.
"""

import pytest

from splatmill_worker.splat.train.validation import validation_indices


@pytest.mark.parametrize(("photos", "count"), [(2, 1), (12, 1), (43, 3), (100, 8), (500, 8)])
def test_the_middles_of_equal_parts_are_set_aside(photos: int, count: int) -> None:
    chosen = validation_indices(photos, count)
    assert len(set(chosen)) == count
    assert all(part * photos // count <= index < photos for part, index in enumerate(chosen))
    assert all((part + 1) * photos / count > index for part, index in enumerate(chosen))


def test_nothing_is_set_aside_where_nothing_is_asked_for() -> None:
    assert validation_indices(43, 0) == ()


def test_one_photo_is_always_left() -> None:
    with pytest.raises(ValueError, match="leaves none to train on"):
        validation_indices(2, 2)
