"""Proves that the probe gives positive times, leaves the engine as it was, and times a scene that has grown.

Does not prove that the times are right: they depend on what else runs, and `bench train` compares them with whole runs.
"""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from splatmill_worker.splat.engine.open import gaussians_of
from splatmill_worker.splat.engine.protocol import StepResult
from splatmill_worker.splat.plan.probe import GROWN, PHOTOS, grown, probe
from tests.support.training import first_engine, split


def test_a_probe_leaves_the_engine_as_it_was() -> None:
    engine, (views, _) = first_engine(), split()
    before = {name: value.clone() for name, value in engine.parameters().items()}
    speed = probe(engine, views)
    assert speed.per_pixel > 0
    assert speed.per_gaussian > 0
    after = engine.parameters()
    assert all(torch.equal(after[name], value) for name, value in before.items())
    assert not any(moment.any() for moment in engine.moments())
    assert all(set(view.levels) == {1} for view in views)
    assert speed.step(2, 0) == 2 * speed.per_pixel
    assert speed.step(0, 3) == 3 * speed.per_gaussian


@pytest.mark.parametrize("photos", [1, 2, 3])
def test_fewer_photos_than_are_timed_are_timed_more_than_once(photos: int) -> None:
    views, _ = split()
    assert probe(first_engine(), views[:photos], most=2000).per_pixel > 0


def test_no_further_photo_is_timed_once_the_time_is_spent(monkeypatch: pytest.MonkeyPatch) -> None:
    engine, (views, _) = first_engine(), split()
    taken: list[object] = []
    step = engine.train_photo

    def counted(*arguments: Any, **named: Any) -> StepResult:
        taken.append(arguments)
        return step(*arguments, **named)

    monkeypatch.setattr(engine, "train_photo", counted)
    monkeypatch.setattr("splatmill_worker.splat.plan.probe.LONGEST", math.inf)
    probe(engine, views, most=2000)
    whole = len(taken)
    monkeypatch.setattr("splatmill_worker.splat.plan.probe.LONGEST", 0.0)
    probe(engine, views, most=2000)
    assert len(taken) - whole == whole // PHOTOS > 0


def test_a_scene_that_has_grown_covers_what_the_first_gaussians_covered() -> None:
    first = gaussians_of(first_engine())
    many = grown(first, GROWN)
    assert many.count == GROWN > 2 * first.count
    original = torch.arange(GROWN) * first.count // GROWN
    copies = original.bincount()
    assert int(copies.max() - copies.min()) <= 1
    # As many times smaller an area as there are copies of it.
    area = ((2.0 * first.log_scales[:, 0]).exp() * copies).sum() * first.count / GROWN
    smaller = math.log(GROWN / first.count) / 2.0
    assert torch.allclose(many.log_scales, first.log_scales[original] - smaller, atol=1e-5)
    assert float((2.0 * many.log_scales[:, 0]).exp().sum()) == pytest.approx(float(area), rel=1e-3)
    # Copies lie within a few standard deviations of the original, on all its sides.
    away = (many.means - first.means[original]) / first.log_scales.exp()[original]
    assert float(away.mean().abs()) < 0.05
    assert float(away.std()) == pytest.approx(1.0, rel=0.05)
    assert torch.sigmoid(many.logit_opacities).allclose(torch.tensor(0.3))
    assert many.degree == 3
    assert bool(many.finite().all())


def test_a_scene_with_many_gaussians_is_timed_as_it_is() -> None:
    first = gaussians_of(first_engine())
    same = grown(first, first.count)
    assert same.count == grown(first, 0).count == first.count
    assert grown(first, first.count + 1).count == first.count + 1
    assert torch.equal(same.means, first.means)
    assert torch.equal(same.log_scales, first.log_scales)
    assert math.isclose(float(same.logit_opacities.sum()), float(first.logit_opacities.sum()))
