"""Proves what share of a budget is spent, how it is cut short, and that the clock of training can be stopped.

Does not prove that training asks.
"""

from __future__ import annotations

import math

import pytest

from splatmill_worker.splat.plan.budget import Budget, Clock


def test_a_budget_is_spent_by_whichever_ends_first() -> None:
    assert Budget(100).progress(25, 1e9) == 0.25
    assert Budget(None, 10.0).progress(10**6, 4.0) == 0.4
    assert Budget(100, 10.0).progress(50, 9.0) == 0.9
    assert Budget(100).progress(1000, 0.0) == 1.0
    with pytest.raises(ValueError, match="neither"):
        Budget(None)


def test_the_rest_of_a_budget_is_worth_so_many_steps() -> None:
    assert Budget(100).steps_left(40, 1e9, each=0.1) == 60
    assert Budget(None, 10.0).steps_left(40, 4.0, each=0.5) == pytest.approx(12)
    assert Budget(45, 10.0).steps_left(40, 4.0, each=0.5) == 5
    assert Budget(None, 10.0).steps_left(40, 11.0, each=0.5) == 0


def test_a_budget_cut_short_ends_after_a_tail() -> None:
    assert Budget(1000).ending_at(0.5, 0.1) == Budget(550)
    assert Budget(None, 60.0).ending_at(0.5, 0.1).seconds == pytest.approx(33.0)
    assert Budget(1000).ending_at(0.99, 0.1) == Budget(1000)
    assert Budget(1000).ending_at(0.0, 0.1) == Budget(1)


def test_time_inside_stopped_does_not_count() -> None:
    clock = Clock(5.0)
    before = clock.seconds
    with clock.stopped():
        frozen = clock.seconds
        busy = sum(math.sqrt(i) for i in range(20_000))
        assert clock.seconds == frozen
    assert busy > 0
    assert 5.0 <= before <= frozen
    assert frozen <= clock.seconds < frozen + 60
