"""The time that tiles still take follows from those that were trained."""

from __future__ import annotations

import pytest

from splatmill.schema import TrainOptions
from splatmill_worker.tiles.remaining import Remaining
from splatmill_worker.tiles.units import ScenePlan

PLAN = ScenePlan("d", TrainOptions(tiles=4))
BEFORE: dict[str, float | None] = {"cameras": 50.0, "coarse": 70.0}


def test_the_first_tile_stands_for_the_others() -> None:
    left = Remaining.of(PLAN, BEFORE, "tile-1")
    assert (left.tiles, left.seams) == (3, 4)
    assert left.seconds(10.0, 30.0) == pytest.approx(30.0 + 3 * 40.0 + 4 * 10.0)


def test_tiles_and_last_steps_take_what_the_others_took() -> None:
    trained = BEFORE | {"tile-1": 20.0, "tile-2": 40.0, "tile-4": None}
    assert Remaining.of(PLAN, trained, "tile-3").seconds(5.0, 25.0) == pytest.approx(25.0 + 3 * 7.5)
    trained |= {"tile-3": 30.0, "seam-1": 8.0, "seam-4": 0.0}
    left = Remaining.of(PLAN, trained, "seam-2")
    assert (left.tiles, left.seams) == (0, 1)
    assert left.seconds(6.0, 6.0) == pytest.approx(6.0 + 10.0), "nothing was left to do for seam-4"
