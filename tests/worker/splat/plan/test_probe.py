"""Proves that the probe gives positive times and leaves the engine as it was.

Does not prove that the times are right: they depend on what else runs.
"""

from __future__ import annotations

import torch

from splatmill_worker.splat.plan.probe import probe
from tests.support.training import first_engine, split


def test_a_probe_leaves_the_engine_as_it_was() -> None:
    engine, (views, _) = first_engine(), split()
    before = {name: value.clone() for name, value in engine.parameters().items()}
    speed = probe(engine, views)
    assert speed.per_pixel > 0
    assert speed.per_gaussian > 0
    after = engine.parameters()
    assert all(torch.equal(after[name], value) for name, value in before.items())
    assert speed.step(2, 0) == 2 * speed.per_pixel
    assert speed.step(0, 3) == 3 * speed.per_gaussian
