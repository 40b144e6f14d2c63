"""Gaussians of a context are rendered and hide others, and no step moves them or counts them.

The truth is a scene of all Gaussians, in which those of the context are put back after every step, and plain torch.
"""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from splatmill_worker.kernels.cpu.step import Step
from splatmill_worker.kernels.records import PartOf
from splatmill_worker.splat.engine.autograd import AutogradEngine
from splatmill_worker.splat.engine.open import open_engine
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.plan.plan import Kernels
from tests.kernels.cpu.test_cpu_clusters import HEIGHT, NAMES, RATES, WIDTH, K, camera, street

SCORES = ("plain_sum", "visible_count", "max_extent")
BACKGROUND = torch.tensor([0.2, 0.4, 0.6])


def scene(n: int = 700) -> tuple[list[Tensor], Tensor]:
    """A street, and which of its Gaussians are the context: those of its second half, among the others in depth."""
    groups = street(n, seed=3)
    return groups, groups[0][:, 0] > 20.0


def photo(step: int) -> Tensor:
    return torch.randint(
        0, 256, (HEIGHT, WIDTH, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(step)
    )


def train(engine: Step, step: int) -> float:
    """The loss of a step along the street, the middle of which shows both halves."""
    view = camera(18.0 + step % 5)
    return engine.train(
        view, K, photo(step), degree=3, rates=RATES, step=step + 1, background=BACKGROUND
    ).loss


def free_of(groups: list[Tensor], rows: Tensor) -> list[Tensor]:
    return [group[rows] for group in groups]


def named(groups: list[Tensor], rows: Tensor) -> dict[str, Tensor]:
    return {name: group[rows] for name, group in zip(NAMES, groups, strict=True)}


@pytest.mark.parametrize("clustered", [False, True])
def test_steps_are_those_of_a_scene_whose_context_is_put_back(clustered: bool) -> None:
    groups, apart = scene()
    engine = Step(*free_of(groups, ~apart), clustered=clustered, context=named(groups, apart))
    order = torch.cat([torch.where(~apart)[0], torch.where(apart)[0]])
    free = int((~apart).sum())
    whole = Step(*(group[order] for group in groups))
    before = whole.parameters()
    for step in range(12):
        assert train(engine, step) == pytest.approx(train(whole, step), rel=2e-6)
        first, second = whole.moments()
        moved = whole.parameters()
        scores = {name: getattr(whole, name).clone() for name in SCORES}
        if step == 0:
            for name in SCORES:
                torch.testing.assert_close(getattr(engine, name), scores[name][:free], rtol=1e-4, atol=1e-7)
        first[free:], second[free:] = 0, 0
        whole.replace({k: torch.cat([v[:free], before[k][free:]]) for k, v in moved.items()}, first, second)
    assert engine.count == free
    for name, value in engine.parameters().items():
        assert len(value) == free
        # The moments of a `replace` are rounded anew, and those of a step are not.
        torch.testing.assert_close(value, moved[name][:free], rtol=5e-3, atol=5e-3)


def test_what_a_context_hides_is_not_trained() -> None:
    groups, _ = scene(300)
    wall = [
        torch.tensor([[20.0, 1.0, -1.0]]),
        torch.full((1, 3), 2.0),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.tensor([12.0]),
        torch.zeros(1, 16, 3),
    ]
    # A Gaussian is opaque in its middle alone: what lies behind that is hidden from a camera of a few pixels.
    context = dict(zip(NAMES, (group.repeat(8, *[1] * (group.ndim - 1)) for group in wall), strict=True))
    engine = Step(*groups, context=context)
    small = torch.tensor([[400.0, 0, 4], [0, 400.0, 4], [0, 0, 1]])
    before = engine.parameters()
    result = engine.train(
        camera(20.0), small, torch.full((8, 8, 3), 255, dtype=torch.uint8), degree=3, rates=RATES, step=1
    )
    assert result.loss > 0.1
    for name, value in engine.parameters().items():
        torch.testing.assert_close(value, before[name], rtol=0, atol=0)


def test_renderings_have_the_context_and_lists_have_not() -> None:
    groups, apart = scene()
    engine = Step(*free_of(groups, ~apart), context=named(groups, apart))
    whole = Step(*groups)
    shown, _, _ = engine.forward(camera(20.0), K, WIDTH, HEIGHT, degree=3)
    expected, _, _ = whole.forward(camera(20.0), K, WIDTH, HEIGHT, degree=3)
    torch.testing.assert_close(shown, expected, rtol=1e-5, atol=1e-6)
    assert engine.count == int((~apart).sum())
    assert [len(moments) for moments in engine.moments()] == [engine.count, engine.count]
    blocks = -(-engine.count // 16)
    assert [len(engine.exp_avg), len(engine.exp_avg_sq)] == [blocks, blocks], "none of what stays where it is"
    kept = {name: value[: engine.count // 2] for name, value in engine.parameters().items()}
    engine.replace(kept, None, None)
    assert engine.count == len(kept["means"])
    for name, value in engine.parameters().items():
        assert torch.equal(value, kept[name])
    assert math.isfinite(train(engine, 0))


def test_the_reference_has_the_same_context() -> None:
    groups, apart = scene(160)
    free, context = (Gaussians(**named(groups, rows)) for rows in (~apart, apart))
    fused, plain = open_engine(free, "cpu", context=context), AutogradEngine(free, context=context)
    for engine in (fused, plain):
        engine.keep_scores = True
        engine.train_photo(camera(20.0), K, photo(1), degree=3, rates=RATES, step=1, background=BACKGROUND)
    for name in SCORES:
        torch.testing.assert_close(getattr(fused, name), getattr(plain, name), rtol=1e-3, atol=1e-6)
    for first, second in zip(fused.moments(), plain.moments(), strict=True):
        torch.testing.assert_close(first.abs().sum(), second.abs().sum(), rtol=2e-3, atol=1e-9)
    before = free.parameters()
    for name, value in fused.parameters().items():
        # Adam's first step is the rate, whatever the gradient's size: it is left out where that is nearly zero.
        moves, others = value - before[name], plain.parameters()[name] - before[name]
        assert float((moves - others).abs().gt(1e-4).float().mean()) < 0.02


def test_what_a_context_excludes_is_refused() -> None:
    groups, apart = scene()
    engine = Step(*free_of(groups, ~apart), context=named(groups, apart))
    with pytest.raises(ValueError, match="pose_gradient"):
        engine.train(camera(20.0), K, photo(0), degree=3, rates=RATES, step=1, pose_gradient=True)
    with pytest.raises(ValueError, match="context"):
        open_engine(Gaussians(*groups), "gpu", context=Gaussians(*groups))
    with pytest.raises(ValueError, match="means"):
        Step(*groups, context={**named(groups, apart), "means": torch.zeros(3, 2)})


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_a_part_of_a_photo_is_trained_as_the_photo_is(backend: Kernels) -> None:
    groups, _ = scene(160)
    left, top, right, bottom = 16, 8, 48, 32
    whole_photo, mask = photo(1), torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[top:bottom, left:right] = True
    mask[20:24, 30:40] = False
    shifted = K.clone()
    shifted[:2, 2] -= torch.tensor([left, top])
    gaussians = Gaussians(**dict(zip(NAMES, groups, strict=True)))
    whole, part, apart = (open_engine(gaussians, backend) for _ in range(3))
    used = int(mask.sum())
    common: dict[str, Any] = {"degree": 3, "rates": RATES, "step": 1, "background": BACKGROUND}
    expected = whole.train_photo(camera(20.0), K, whole_photo, mask=mask, **common)
    cut, cut_mask = (each[top:bottom, left:right].contiguous() for each in (whole_photo, mask))
    for engine, counted in ((part, used), (apart, 4 * used)):
        of = PartOf(WIDTH, HEIGHT, counted)
        result = engine.train_photo(camera(20.0), shifted, cut, mask=cut_mask, part_of=of, **common)
    assert result.loss == pytest.approx(expected.loss, rel=1e-5)
    shown = part.visible_count > 0  # outside of the part, the photo shows others
    torch.testing.assert_close(part.plain_sum[shown], whole.plain_sum[shown], rtol=1e-3, atol=1e-8)
    torch.testing.assert_close(part.max_extent[shown], whole.max_extent[shown], rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(apart.plain_sum, part.plain_sum / 4, rtol=1e-5, atol=1e-10)
    for first, other, factor in zip(part.moments(), apart.moments(), (4, 16), strict=True):
        torch.testing.assert_close(factor * other, first, rtol=1e-4, atol=1e-12)
    torch.testing.assert_close(part.moments()[0][shown], whole.moments()[0][shown], rtol=1e-3, atol=1e-7)
    for name, value in part.parameters().items():
        torch.testing.assert_close(value[shown], whole.parameters()[name][shown], rtol=1e-4, atol=1e-4)
