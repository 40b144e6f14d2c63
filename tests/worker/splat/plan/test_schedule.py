"""Proves how resolution, densification and learning rates follow from step and progress.

Does not prove that these schedules train well.
"""

from __future__ import annotations

import math

import pytest

from splatmill_worker.splat.plan.budget import Budget
from splatmill_worker.splat.plan.rates import Annealing, RateSchedule, beta2_of, boost_of
from splatmill_worker.splat.plan.schedule import Schedule


def test_the_schedule_goes_from_coarse_to_fine() -> None:
    schedule = Schedule(Budget(1000), ((0, 4), (200, 2), (500, 1)), 3, 300, 100, 0.7, 1000)
    assert [schedule.reduction(step) for step in (1, 200, 201, 500, 501, 1000)] == [4, 4, 2, 2, 1, 1]
    events = [step for step in range(1, 1001) if schedule.densifies(step, step / 1000)]
    assert events == [300, 400, 500, 600]


def test_gaussians_are_left_out_once_each_photo_came_often() -> None:
    schedule = Schedule(Budget(1000), ((0, 1),), 3, 300, 100, 0.7, 1000, dropout=0.2)
    assert [schedule.left_out(visits) for visits in (0, 1, 99.9, 100)] == [0.0] * 4
    assert schedule.left_out(150) == pytest.approx(0.1)
    assert schedule.left_out(200) == schedule.left_out(1e9) == 0.2
    assert Schedule(Budget(1000), ((0, 1),), 3, 300, 100, 0.7, 1000).left_out(1e9) == 0.0


def test_rates_fall_to_their_ends() -> None:
    rates = RateSchedule(extent=2.0)
    start, end = rates.at(0.0), rates.at(1.0)
    assert start.means == pytest.approx(3.2e-4)
    assert end.means == pytest.approx(0.01 * start.means)
    assert end.sh_dc == pytest.approx(0.1 * start.sh_dc)
    assert start.sh_rest == pytest.approx(start.sh_dc / 30)
    assert all(math.isfinite(value) for value in end.rows())


def test_all_but_the_positions_hold_their_rates_first() -> None:
    rates = RateSchedule(extent=1.0)
    assert rates.at(0.6).log_scales == rates.at(0.0).log_scales
    assert rates.at(0.61).log_scales < rates.at(0.0).log_scales
    assert rates.at(0.5).means == pytest.approx(0.1 * rates.at(0.0).means)


def test_a_resumed_run_scales_every_rate() -> None:
    full, halved = RateSchedule(2.0).at(0.3), RateSchedule(2.0, scale=0.5).at(0.3)
    assert halved.rows() == pytest.approx([0.5 * value for value in full.rows()])


def test_a_boost_enlarges_steps_and_those_of_opacities_by_its_root() -> None:
    plain, boosted = RateSchedule(2.0).at(0.2), RateSchedule(2.0, Annealing(boost=4.0)).at(0.2)
    assert boosted.means == pytest.approx(4 * plain.means)
    assert boosted.logit_opacities == pytest.approx(2 * plain.logit_opacities)
    assert boosted.sh_rest == pytest.approx(4 * 2 * 1.25e-4)
    assert plain.sh_rest == pytest.approx(1.25e-4 * 2 / 3)


def test_view_dependent_colour_travels_as_far_in_any_run_of_3300_to_30000_steps() -> None:
    def reach(steps: int) -> float:
        return steps * RateSchedule(1.0, Annealing(boost=boost_of(steps))).at(0.0).sh_rest

    assert [reach(steps) for steps in (3334, 10_000)] == pytest.approx([reach(30_000)] * 2)
    assert reach(1000) < reach(30_000)


def test_squared_gradients_are_averaged_over_fewer_steps_of_a_short_run() -> None:
    windows = [1 / (1 - beta2_of(steps)) for steps in (10, 300, 750, 1500, 3000, 30_000)]
    assert windows == pytest.approx([50, 50, 125, 1000 / 8**0.5, 1000, 1000])
    assert RateSchedule(2.0, Annealing(beta2=beta2_of(750))).at(0.5).beta2 == pytest.approx(0.992)
    assert RateSchedule(2.0).at(0.5).beta2 == 0.999


def test_a_boost_left_to_the_run_is_no_rate() -> None:
    with pytest.raises(ValueError, match="boost is None"):
        RateSchedule(2.0, Annealing(boost=None)).at(0.5)
