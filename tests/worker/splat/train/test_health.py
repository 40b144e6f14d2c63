"""Proves which courses of the loss count as a divergence, which states are worth a snapshot, and what is empty.

Does not prove that training recovers: test_train.py does.
"""

from __future__ import annotations

import math

import pytest
import torch

from splatmill_worker.errors import FailureName, TrainingFailed
from splatmill_worker.splat.train.health import EMPTY_STEPS, GRACE_STEPS, LossHealth, not_finite


def watched(health: LossHealth, first: int, losses: list[float], visible: int = 1) -> LossHealth:
    for i, loss in enumerate(losses):
        health.check(first + i, loss, visible)
    return health


def test_a_rise_of_the_smoothed_loss_is_a_divergence() -> None:
    health = watched(LossHealth(checked_from=0), 1, [0.1] * 50)
    with pytest.raises(TrainingFailed) as failed:
        watched(health, 51, [1.0] * 50)
    assert failed.value.name is FailureName.divergence
    assert "from 0.100 to" in failed.value.symptom


def test_one_bad_photo_is_no_divergence_and_no_moment_for_a_snapshot() -> None:
    health = watched(LossHealth(checked_from=0), 1, [0.1] * 50)
    assert health.near_lowest
    watched(health, 51, [2.0])
    assert not health.near_lowest


def test_an_expected_rise_is_let_pass_and_the_loss_is_compared_with_later_ones() -> None:
    health = watched(LossHealth(checked_from=0), 1, [0.1] * 50)
    health.expect_rise(51)
    watched(health, 51, [0.6] * (GRACE_STEPS + 20))
    assert health.lowest == pytest.approx(0.6, rel=0.05)


@pytest.mark.parametrize("loss", [math.nan, math.inf])
def test_a_loss_that_is_not_finite_is_a_failure_at_once(loss: float) -> None:
    with pytest.raises(TrainingFailed) as failed:
        LossHealth().check(1, loss, 1)
    assert failed.value.name is FailureName.non_finite


def test_photos_without_any_gaussian_in_a_row_mean_an_empty_scene() -> None:
    health = watched(LossHealth(), 1, [0.1] * (EMPTY_STEPS - 1), visible=0)
    watched(health, EMPTY_STEPS, [0.1], visible=1)
    watched(health, EMPTY_STEPS + 1, [0.1] * (EMPTY_STEPS - 1), visible=0)
    with pytest.raises(TrainingFailed) as failed:
        health.check(2 * EMPTY_STEPS, 0.1, 0)
    assert failed.value.name is FailureName.empty_scene


def test_values_that_are_not_finite_are_counted_also_where_a_sum_overflows() -> None:
    most = torch.finfo(torch.float32).max
    assert not_finite(torch.full((1000, 3), most)) == 0
    assert not_finite(torch.zeros(0, 3)) == 0
    assert not_finite(torch.tensor([[1.0, math.inf, 2.0], [math.nan, -math.inf, most]])) == 3
