"""Proves that training which runs out of memory rolls back, continues with fewer Gaussians, and warns of it.

The shortage is made by an engine that refuses to hold more than so many Gaussians. Does not prove that a real
device's allocator reports a shortage.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch

from splatmill_worker.errors import FailureName, TrainingFailed
from splatmill_worker.splat.engine.cpu import CpuEngine
from splatmill_worker.splat.engine.open import gaussians_of
from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.train.loop import Hooks, train
from tests.support import still_life
from tests.support.training import first_engine, plan


class Cramped:
    """An engine whose steps run out of memory above `room` Gaussians."""

    def __init__(self, engine: Engine, room: int) -> None:
        self._engine, self._room = engine, room

    def __getattr__(self, name: str) -> Any:
        return getattr(self._engine, name)

    def train_photo(self, *arguments: Any, **options: Any) -> Any:
        if self._engine.count > self._room:
            raise MemoryError(f"No room for {self._engine.count} Gaussians.")
        return self._engine.train_photo(*arguments, **options)


def test_training_shrinks_and_goes_on() -> None:
    engine = first_engine()
    room = engine.count + 50  # the first densification outgrows it
    said: list[str] = []
    cramped: Any = Cramped(engine, room)
    views = still_life.training_views()
    done = train(cramped, views[1:], views[:1], plan(200), extent=1.1, hooks=Hooks(warn=said.append))
    assert done.failure is None
    assert done.steps == 200
    assert 0 < done.gaussians.count <= room
    assert torch.isfinite(done.gaussians.means).all()
    assert done.recoveries >= 1
    assert all("No room for" in sentence and "at most" in sentence for sentence in said)


def test_memory_that_never_suffices_is_a_named_failure() -> None:
    cramped: Any = Cramped(first_engine(), 0)
    views = still_life.training_views()
    with pytest.raises(TrainingFailed) as raised:
        train(cramped, views[1:], views[:1], plan(200), extent=1.1)
    assert raised.value.name is FailureName.memory


@pytest.mark.parametrize("photos", [0, 2, 100])
def test_statistics_of_photos_are_kept_up_to_a_limit_and_change_no_result(photos: int) -> None:
    views = still_life.training_views()
    of_one = 28 * views[0].full.rgb[..., 0].numel()
    engine = CpuEngine(gaussians_of(first_engine()), most_kept=of_one * photos)
    limited = train(engine, views, [], plan(60), extent=1.1)
    whole_engine = CpuEngine(gaussians_of(first_engine()))
    whole = train(whole_engine, views, [], plan(60), extent=1.1)
    kept = sum(28 * stats.used.numel() for stats in engine._kept.values())
    assert of_one * (photos - 1) < kept <= of_one * photos or engine._kept.keys() == whole_engine._kept.keys()
    for one, other in zip(limited.gaussians, whole.gaussians, strict=True):
        assert torch.equal(one, other)
