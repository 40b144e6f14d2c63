"""Proves that the number of steps which a time budget holds is corrected by the steps timed so far."""

from __future__ import annotations

import pytest

from splatmill_worker.splat.plan.budget import Budget
from splatmill_worker.splat.train.pace import Pace


def test_the_forecast_holds_until_a_hundred_steps_are_timed() -> None:
    pace, budget = Pace(30_000), Budget(None, 100.0)
    for _ in range(99):
        pace.record(0.1)
    assert pace.steps(budget, 99, 9.9) == 30_000
    pace.record(0.1)
    assert pace.steps(budget, 100, 10.0) == 1000


def test_slower_steps_mean_fewer() -> None:
    pace, budget = Pace(30_000), Budget(None, 100.0)
    for _ in range(2000):
        pace.record(0.2)
    assert pace.steps(budget, 1100, 60.0) == pytest.approx(1300, abs=1)
    assert pace.steps(Budget(1200, 100.0), 1100, 60.0) == 1200
    assert pace.steps(budget, 1100, 100.5) == 1100
