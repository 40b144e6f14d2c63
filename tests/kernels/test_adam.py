"""Adam: the definition against torch's own and catch-up against dense steps; the CPU's update against the definition.

The GPU's update is compared in test_gpu_ops. Whether visible-only steps train as well as dense ones is a measurement
(worker/bench), not a test.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from splatmill_worker.kernels import reference
from splatmill_worker.kernels.cpu import isa
from splatmill_worker.kernels.cpu.step import Step
from splatmill_worker.kernels.records import GROUPS, Rates
from tests.support.kernels.cases import scene
from tests.support.kernels.fuzz import inputs, same_bits
from tests.support.kernels.proof import EPS, use

SHAPES = [(3,), (3,), (4,), (), (1, 3), (15, 3)]
RATES = [1.6e-4, 5e-3, 1e-3, 5e-2, 2.5e-3, 1.25e-4]
COLUMNS = [*list(GROUPS.values())[:-1], 3, GROUPS["sh"] - 3]
"""Parameters with a rate of their own."""

State = tuple[list[Tensor], list[Tensor], list[Tensor]]


def start(n: int, dtype: torch.dtype) -> State:
    g = torch.Generator().manual_seed(3)
    params = [torch.randn(n, *s, generator=g).to(dtype) for s in SHAPES]
    return params, [torch.zeros_like(p) for p in params], [torch.zeros_like(p) for p in params]


def gradients(n: int, step: int) -> list[Tensor]:
    """Gradients over ten orders of magnitude."""
    g = torch.Generator().manual_seed(100 + step)
    return [torch.randn(n, *s, generator=g) * 10.0 ** -(10 * torch.rand(n, *s, generator=g)) for s in SHAPES]


@pytest.mark.parametrize("beta2", [0.999, 0.98])
def test_the_definition_is_torchs(beta2: float) -> None:
    params, m, v = start(50, torch.float64)
    theirs = [p.clone().requires_grad_() for p in params]
    torch_adam = torch.optim.Adam(
        [{"params": [p], "lr": r} for p, r in zip(theirs, RATES, strict=True)], betas=(0.9, beta2), eps=1e-15
    )
    for step in range(1, 30):
        grads = [g.double() for g in gradients(50, step)]
        for p, g in zip(theirs, grads, strict=True):
            p.grad = g
        torch_adam.step()
        assert reference.adam_(params, grads, m, v, RATES, step=step, beta2=beta2) == 0
    for a, b in zip(params, theirs, strict=True):
        assert torch.allclose(a, b.detach(), rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize(("beta2", "left_out"), [(0.999, 1e-12), (0.98, 1e-11)])
def test_catch_up_is_dense_adam_with_zero_gradients(beta2: float, left_out: float) -> None:
    """A row left alone for k steps and then caught up is where dense steps with zero gradients would have put it.

    Left out are the terms beyond MEMORY, whose sum is (0.9 / sqrt beta2)^256 / (1 - 0.9 / sqrt beta2) of m / sqrt(v).
    That is 0.1 / sqrt(1 - beta2) at most after one gradient, and moves by the largest rate, 0.05: 2e-11 * 3.2 * 0.05
    for 0.999, and 2.8e-10 * 0.7 * 0.05 for 0.98.
    """
    for missed in (1, 7, 100, 400):
        dense, lazy = start(20, torch.float64), start(20, torch.float64)
        first = [g.double() + 1e-3 for g in gradients(20, 1)]
        last = torch.zeros(20, dtype=torch.int32)
        every = torch.ones(20, dtype=torch.bool)
        reference.adam_(*((dense[0], first, *dense[1:])), RATES, step=1, beta2=beta2)
        reference.adam_(
            *((lazy[0], first, *lazy[1:])), RATES, step=1, visible=every, last_step=last, beta2=beta2
        )
        zero = [torch.zeros_like(g) for g in first]
        for step in range(2, 2 + missed):
            reference.adam_(*((dense[0], zero, *dense[1:])), RATES, step=step, beta2=beta2)
        reference.catch_up_(
            lazy[0], *lazy[1:], RATES, step=1 + missed, rows=every, last_step=last, beta2=beta2
        )
        for a, b in zip((*lazy[0], *lazy[1], *lazy[2]), (*dense[0], *dense[1], *dense[2]), strict=True):
            # eps, 1e-15, beside sqrt(v) >= 3e-5 is what the table leaves out.
            assert torch.allclose(a, b, rtol=1e-9, atol=left_out)


def test_state_of_rarely_seen_rows_neither_underflows_nor_leaps() -> None:
    """One gradient of any size, thousands of steps of nothing, then the same again: no step beyond Adam's own
    bound."""
    sizes = torch.logspace(-30, 15, 46)
    params, m, v = ([torch.zeros(46, 1)] for _ in range(3))
    last, every = torch.zeros(46, dtype=torch.int32), torch.ones(46, dtype=torch.bool)
    for step in (1, 5001, 30001):
        before = params[0].clone()
        reference.adam_(params, [sizes[:, None]], m, v, [1.0], step=step, visible=every, last_step=last)
        travel = (params[0] - before).abs()
        assert torch.isfinite(travel).all()
        # A gradient after silence moves (1 - beta1) / sqrt(1 - beta2) = 3.17 rates; the drift that follows, and
        # that the next visit catches up on, is 9.05 times as much: dense Adam's own bound.
        assert float(travel.max()) <= 3.17 * 10.05
        assert float(travel[sizes > 1e-12].min()) >= 0.5, "a gradient above eps moves its parameter"


@pytest.mark.parametrize("build", isa.supported())
@inputs(20)
@given(
    count=st.sampled_from([1, 2, 15, 16, 17, 40]),
    seed=st.integers(0, 2**16),
    size=st.floats(-18, 10),
    decades=st.floats(0, 12),
    steps=st.integers(1, 5),
    beta2=st.sampled_from([0.999, 0.98]),
    bad=st.sampled_from([float("nan"), float("inf"), 1e25]),
)
def test_fuzz_the_update_of_the_cpu(
    build: str, count: int, seed: int, size: float, decades: float, steps: int, beta2: float, bad: float
) -> None:
    """The definition's parameters and moments; at the end, bad gradients move nothing that they reach, and count."""
    g = torch.Generator().manual_seed(seed)
    case = scene("adam", count, seed=seed)
    rates = replace(Rates(*RATES), beta2=beta2)
    largest = torch.zeros(count, 59)
    with use(f"cpu:{build}"):
        step = Step(*case.groups())
        want = [rows(step.parameters()).double(), *(torch.zeros(count, 59).double() for _ in range(2))]
        for number in range(1, steps + 1):
            image, *_ = step.forward(*case.camera(), case.width, case.height, degree=3)
            d_color = torch.randn(image.shape, generator=g) * 10 ** (
                size - decades * torch.rand(image.shape, generator=g)
            )
            slopes = rows(step.gradients(d_color))
            largest = largest.maximum(slopes.abs())
            p, grads, m, v = (x.split(COLUMNS, 1) for x in (want[0], slopes.double(), *want[1:]))
            assert reference.adam_(p, grads, m, v, RATES, step=number, beta2=beta2) == 0
            assert step.backward_update(d_color, rates=rates, step=number) == 0
        after = [rows(step.parameters()), *step.moments()]
        step.forward(*case.camera(), case.width, case.height, degree=3)
        d_color = torch.full((case.height, case.width, 3), bad)
        wrong = ~torch.isfinite(rows(step.gradients(d_color)).square())
        assert step.backward_update(d_color, rates=rates, step=steps + 1) == wrong.sum()
    # Each step rounds the parameter once and its update, of at most 3.2 rates, to 24 eps; below 1e-15, Adam's eps, the
    # square of a gradient leaves float32 while eps outweighs its root: a thousandth of a rate.
    bound = steps * (
        2 * EPS * want[0].abs() + (80 * EPS + 1e-3 * (largest < 1e-15)) * torch.tensor(rates.rows())
    )
    assert ((after[0] - want[0]).abs() <= bound).all()
    for moment, exact, term in zip(after[1:], want[1:], (largest, largest.square()), strict=True):
        assert ((moment - exact).abs() <= 6 * steps * EPS * term + 1e-37).all()
    assert wrong.any() or not largest.any(), "only what no view shows has no gradient"
    for now, before in zip((rows(step.parameters()), *step.moments()), after, strict=True):
        assert torch.isfinite(now).all()
        assert same_bits(now[wrong], before[wrong])


def rows(groups: dict[str, Tensor]) -> Tensor:
    """All parameters of a Gaussian side by side [N, 59]."""
    return torch.cat([groups[name].reshape(len(groups[name]), -1) for name in GROUPS], 1)


@pytest.mark.parametrize("beta2", [0.94, 1.0, float("nan")])
def test_rates_refuse_a_factor_that_no_backend_can_follow(beta2: float) -> None:
    with pytest.raises(ValueError, match=r"^beta2: expected at least 0\.95 and less than 1"):
        Rates(1.0, 1.0, 1.0, 1.0, 1.0, 1.0, beta2)
