"""Proves which Gaussians a step leaves out, that the others make up for them, and that opacities come back.

On a tiny scene, with the engines of every machine; `tests/kernels/gpu/test_gpu_train.py` has the one of the GPU. Does
not prove that it pays: `bench train` measures that (`no-dropout`).
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.plan import schedule as schedule_module
from splatmill_worker.splat.plan.plan import Kernels, Plan
from splatmill_worker.splat.train import run as run_module
from splatmill_worker.splat.train.dropout import MOST_OPAQUE, TRANSPARENT, dropout
from splatmill_worker.splat.train.run import TrainingRun
from splatmill_worker.splat.views import TrainingView
from tests.support.training import first_engine, plan, split


def logits(count: int = 5000) -> Tensor:
    return 3.0 * torch.randn(count, generator=torch.Generator().manual_seed(4))


def opacities(engine: Engine) -> Tensor:
    return engine.parameters()["logit_opacities"].float()


def test_the_asked_share_is_left_out_and_the_others_make_up_for_it() -> None:
    before = logits()
    within = before.clone()
    with dropout(within, 0.25, seed=1):
        gone = within == TRANSPARENT
        # Five standard deviations of the number of 5000 that are drawn.
        assert abs(int(gone.sum()) - 1250) < 5 * (5000 * 0.25 * 0.75) ** 0.5
        was, now = torch.sigmoid(before[~gone]), torch.sigmoid(within[~gone])
        free = was < 0.75 * MOST_OPAQUE
        assert torch.allclose(now[free], was[free] / 0.75, rtol=1e-5)
        assert bool((now >= was).all()), "what is nearly opaque does not become less so"
        assert bool(torch.isfinite(within).all())
    assert torch.allclose(within, before, atol=5e-6)


@pytest.mark.parametrize("logit", [-100.0, -20.0, 0.0, 20.0, 100.0])
def test_extreme_opacities_stay_finite_and_come_back(logit: float) -> None:
    within = torch.full((64,), logit)
    with dropout(within, 0.9, seed=3):
        assert bool(torch.isfinite(within).all())
    assert torch.allclose(within, torch.full((64,), logit), rtol=1e-6)


def test_a_step_moves_what_it_would_have_moved() -> None:
    before = logits()
    within = before.clone()
    with dropout(within, 0.5, seed=1):
        within += 0.125
    assert torch.allclose(within, before + 0.125, atol=5e-6)


def test_opacities_come_back_after_an_error() -> None:
    within = logits()
    with pytest.raises(MemoryError), dropout(within, 0.5, seed=1):
        raise MemoryError
    assert torch.allclose(within, logits(), atol=5e-6)


def test_the_choice_follows_from_the_seed() -> None:
    chosen = []
    for seed in (7, 7, 8):
        within = logits()
        with dropout(within, 0.5, seed=seed):
            chosen.append(within == TRANSPARENT)
    assert torch.equal(chosen[0], chosen[1])
    # Two independent choices of a half agree on a half.
    assert 0.45 < float((chosen[0] == chosen[2]).float().mean()) < 0.55


def test_without_a_share_nothing_is_touched() -> None:
    within = logits()
    with dropout(within, 0.0, seed=1):
        assert torch.equal(within, logits())


@pytest.mark.parametrize("kernels", ["cpu", "reference"])
def test_the_engines_opacities_are_written_in_place(kernels: Kernels) -> None:
    engine = first_engine(kernels, most=40)
    before = opacities(engine)
    assert engine.logit_opacities.numel() >= engine.count
    with dropout(engine.logit_opacities, 0.5, seed=1):
        gone = opacities(engine) == TRANSPARENT
        assert 5 <= int(gone.sum()) <= 35
    assert torch.allclose(opacities(engine), before, atol=5e-6)


@pytest.mark.parametrize("kernels", ["cpu", "reference"])
def test_a_first_step_moves_only_what_it_is_taken_on(kernels: Kernels) -> None:
    views, _ = split()
    course = plan(10, kernels=kernels)
    whole = a_step(first_engine(kernels, most=40), course, views, share=0.0)
    part = a_step(first_engine(kernels, most=40), course, views, share=0.5)
    assert int(whole.sum()) > 20
    assert int(whole.sum()) / 4 < int(part.sum()) < int(whole.sum())
    assert not bool((part & ~whole).any())


def a_step(engine: Engine, course: Plan, views: list[TrainingView], share: float) -> Tensor:
    """Which Gaussians one step moves, with that share left out."""
    before = engine.parameters()["sh"].clone()
    run = TrainingRun(engine, course, views, 1.1)
    with dropout(engine.logit_opacities, share, seed=2):
        run.advance()
    return (engine.parameters()["sh"] != before).flatten(1).any(dim=1)


@pytest.mark.parametrize("aside", [None, 2])
def test_a_run_leaves_out_more_as_photos_come_again(
    aside: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[float, int]] = []

    def noted(logit_opacities: Tensor, share: float, seed: int) -> AbstractContextManager[None]:
        asked.append((share, seed))
        return dropout(logit_opacities, share, seed)

    monkeypatch.setattr(run_module, "dropout", noted)
    monkeypatch.setattr(schedule_module, "MANY_VISITS", 2)
    views = split()[0][:6]
    course = plan(40, densify=False, validation=aside)
    run = TrainingRun(
        first_engine(), replace(course, schedule=replace(course.schedule, dropout=0.4)), views, 1.1
    )
    for _ in range(40):
        run.advance()
    shares = [share for share, _ in asked]
    photos = 6 - (aside or 0)
    assert shares == pytest.approx([0.4 * min(1, max(0, (n + 1) / photos / 2 - 1)) for n in range(40)])
    assert shares[2 * photos - 1] == 0.0
    assert shares[-1] == 0.4
    assert len({seed for _, seed in asked}) == 40
