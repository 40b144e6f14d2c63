"""Proves which cells count as sky: a rule on colours and what is above, on plain cases.

Does not prove that real skies follow the rule.
"""

from __future__ import annotations

import numpy as np
import pytest

from splatmill_worker.splat.start.cells import Cells
from splatmill_worker.splat.start.sky import sky_of, sky_share
from tests.support.scenes.street import BLUE, BRICK, street

CLOUD = (215, 218, 225)


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        ([BLUE, CLOUD, BRICK, BLUE], [True, True, False, False]),
        ([BRICK, BLUE, BLUE, BLUE], [False] * 4),
        ([(20, 30, 60), CLOUD, CLOUD, CLOUD], [False] * 4),
        ([(250, 250, 200), CLOUD, CLOUD, CLOUD], [False] * 4),
    ],
)
def test_the_sky_is_blue_or_grey_and_has_nothing_above_it(
    rows: list[tuple[int, int, int]], expected: list[bool]
) -> None:
    assert (
        sky_of(np.array(rows, np.uint8)[:, None], np.ones((len(rows), 1), bool)).ravel().tolist() == expected
    )


def test_sky_continues_below_unused_cells_which_are_none() -> None:
    used = np.array([[True], [False], [True]])
    assert sky_of(np.array([[BLUE]] * 3, np.uint8), used).ravel().tolist() == [True, False, True]


def test_the_share_of_sky_leaves_out_cells_with_points() -> None:
    bare = Cells.of(street(), np.empty((0, 3)))
    assert sky_share([bare]) == pytest.approx(0.5)
    # One point in the sky covers nine cells of 32 x 48.
    assert sky_share([Cells.of(street(), np.array([[0.0, -0.5, 2.0]]))]) == pytest.approx(0.5 - 9 / (32 * 48))
