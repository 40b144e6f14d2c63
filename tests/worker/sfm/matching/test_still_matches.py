"""Proves that matches without motion are dropped where the others moved, and kept where the camera hardly moved, where
it turned about a point, and where all of them stand still.

Not proven here: that SfM then finds the cameras; `tests/inputs/test_static_overlay.py` proves it for a masked logo.
"""

from __future__ import annotations

import numpy as np
import pytest

from splatmill_worker.sfm.matching.two_view import without_still

SIDE = 800


def pair(moving: int, still: int, shift: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Matches of as many features that move by `shift` pixels and that stand still, and both photos' positions."""
    random = np.random.default_rng(0)
    first = random.uniform(0, SIDE, (moving + still, 2))
    angles = random.uniform(0, 2 * np.pi, moving)
    second = first + random.normal(0, 0.2, first.shape)
    second[:moving] += shift * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    matches = np.stack([np.arange(moving + still)] * 2, axis=1).astype(np.uint32)
    return matches, first, second


def test_still_matches_are_dropped_where_the_others_moved() -> None:
    matches, first, second = pair(100, 300, 60.0)
    assert without_still(matches, first, second, SIDE)[:, 0].tolist() == list(range(100))


@pytest.mark.parametrize(
    ("moving", "still", "shift"),
    [(100, 300, 8.0), (300, 10, 60.0), (0, 300, 0.0), (300, 0, 60.0), (0, 0, 0.0)],
    ids=["little motion", "about a point", "all still", "none still", "no matches"],
)
def test_others_are_kept(moving: int, still: int, shift: float) -> None:
    matches, first, second = pair(moving, still, shift)
    np.testing.assert_array_equal(without_still(matches, first, second, SIDE), matches)
