"""Proves that the time on several machines is that of the longest chain, that of all units in turn, or between them.

Does not prove that machines keep to it (`worker/bench/workers`).
"""

from __future__ import annotations

import pytest
from _schedule import makespan

from splatmill.schema import TrainOptions
from splatmill_worker.tiles.units import ScenePlan

PLAN = ScenePlan("", TrainOptions(tiles=3))
SECONDS = {
    "photos": 1.0, "features-1": 4.0, "features-2": 4.0, "features-3": 4.0, "pairs": 2.0, "cameras": 5.0,
    "coarse": 10.0, "tile-1": 3.0, "tile-2": 6.0, "tile-3": 3.0, "seam-1": 2.0, "seam-2": 2.0, "seam-3": 2.0,
    "scene": 4.0,
}  # fmt: skip


@pytest.mark.parametrize(
    ("machines", "seconds"),
    [
        (1, 52.0),
        (2, 1 + 8 + 2 + 5 + 10 + 6 + 4 + 4),  # tile-3 begins when tile-1 has ended
        (3, 1 + 4 + 2 + 5 + 10 + 6 + 2 + 4),
        (30, 1 + 4 + 2 + 5 + 10 + 6 + 2 + 4),
    ],
)
def test_a_machine_that_is_free_takes_the_next_unit(machines: int, seconds: float) -> None:
    assert makespan(PLAN, SECONDS, machines) == seconds


def test_units_without_seconds_take_no_time() -> None:
    assert makespan(PLAN, {"cameras": 5.0, "coarse": 1.0}, 2) == 6.0
