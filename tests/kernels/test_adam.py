"""Adam: every backend against the float64 definition, the definition against torch's own, and catch-up against dense
steps.

Whether visible-only steps train as well as dense ones is a measurement (worker/bench), not a test.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from splatmill_worker.kernels import ops, reference
from splatmill_worker.kernels.records import Rates
from tests.support.kernels.proof import EPS, backends, use

SHAPES = [(3,), (3,), (4,), (), (1, 3), (15, 3)]
RATES = [1.6e-4, 5e-3, 1e-3, 5e-2, 2.5e-3, 1.25e-4]
State = tuple[list[Tensor], list[Tensor], list[Tensor]]


def start(n: int, dtype: torch.dtype, device: str = "cpu") -> State:
    g = torch.Generator().manual_seed(3)
    params = [torch.randn(n, *s, generator=g).to(device, dtype) for s in SHAPES]
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


@pytest.mark.parametrize("backend", backends())
@pytest.mark.parametrize("sparse", [False, True], ids=["dense", "visible only"])
@pytest.mark.parametrize(("n", "beta2"), [(1, 0.999), (17, 0.98), (1003, 0.999)])
def test_steps_are_the_definitions(n: int, beta2: float, sparse: bool, backend: str) -> None:
    device = "cuda" if backend == "gpu" and torch.cuda.is_available() else "cpu"
    got, want = start(n, torch.float32, device), start(n, torch.float64)
    last, last64 = torch.zeros(n, dtype=torch.int32, device=device), torch.zeros(n, dtype=torch.int32)
    steps = 12
    with use(backend) as op:
        for step in range(1, steps + 1):
            grads = gradients(n, step)
            seen = torch.rand(n, generator=torch.Generator().manual_seed(step)) < 0.3 if sparse else None
            kept: dict[str, Any] = {"beta2": beta2} | (
                {} if seen is None else {"visible": seen.to(device), "last_step": last}
            )
            exact: dict[str, Any] = {"beta2": beta2} | (
                {} if seen is None else {"visible": seen, "last_step": last64}
            )
            assert (
                ops.adam_(
                    got[0],
                    [g.to(device) for g in grads],
                    got[1],
                    got[2],
                    RATES,
                    step=step,
                    backend=op,
                    **kept,
                )
                == 0
            )
            reference.adam_(want[0], [g.double() for g in grads], want[1], want[2], RATES, step=step, **exact)
    for a, b, m, m64, v, v64, rate in zip(
        got[0], want[0], got[1], want[1], got[2], want[2], RATES, strict=True
    ):
        # Each step rounds the parameter once (eps |p|, |p| <= 5) and its update, of at most about 10 rates after a
        # catch-up, to 24 eps; the moments gather 4 eps of their largest term a step.
        assert float((a.cpu() - b).abs().max()) <= steps * (6 * EPS + 240 * EPS * rate)
        assert torch.allclose(m.cpu().double(), m64, rtol=steps * 4 * EPS, atol=steps * 4 * EPS)
        assert torch.allclose(v.cpu().double(), v64, rtol=steps * 6 * EPS, atol=1e-30)
    assert torch.equal(last.cpu(), last64)


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


@pytest.mark.parametrize("backend", ["reference", *backends()])
def test_a_gradient_that_is_not_finite_is_refused_and_counted(backend: str) -> None:
    device = "cuda" if backend == "gpu" and torch.cuda.is_available() else "cpu"
    params, m, v = start(40, torch.float32, device)
    grads = [g.to(device) for g in gradients(40, 1)]
    bad = [(0, 3, float("nan")), (2, 11, float("inf")), (5, 600, -float("inf")), (1, 0, 1e25)]
    for group, place, value in bad:
        grads[group].view(-1)[place] = value
    before = [p.clone() for p in params]
    with use(backend) as op:
        assert ops.adam_(params, grads, m, v, RATES, step=1, backend=op) == len(bad)
    for group, (p, old) in enumerate(zip(params, before, strict=True)):
        stayed = {place for g, place, _ in bad if g == group}
        moved = (p != old).view(-1)
        assert torch.isfinite(p).all()
        assert not any(bool(moved[i]) for i in stayed)
        assert int(moved.sum()) >= moved.numel() * 0.5
        for state in (m[group], v[group]):
            assert all(float(state.view(-1)[i]) == 0.0 for i in stayed)


@pytest.mark.parametrize("backend", backends())
def test_state_of_rarely_seen_rows_neither_underflows_nor_leaps(backend: str) -> None:
    """One gradient of any size, thousands of steps of nothing, then the same again: no step beyond Adam's own
    bound."""
    device = "cuda" if backend == "gpu" and torch.cuda.is_available() else "cpu"
    sizes = torch.logspace(-30, 15, 46)
    params, m, v = (
        [torch.zeros(46, 1, device=device)],
        [torch.zeros(46, 1, device=device)],
        [torch.zeros(46, 1, device=device)],
    )
    last = torch.zeros(46, dtype=torch.int32, device=device)
    every = torch.ones(46, dtype=torch.bool, device=device)
    with use(backend) as op:
        for step in (1, 5001, 30001):
            before = params[0].clone()
            ops.adam_(
                params,
                [sizes[:, None].to(device)],
                m,
                v,
                [1.0],
                step=step,
                visible=every,
                last_step=last,
                backend=op,
            )
            travel = (params[0] - before).abs()
            assert torch.isfinite(travel).all()
            # A gradient after silence moves (1 - beta1) / sqrt(1 - beta2) = 3.17 rates; the drift that follows, and
            # that the next visit catches up on, is 9.05 times as much: dense Adam's own bound.
            assert float(travel.max()) <= 3.17 * 10.05
            seen = (sizes > 1e-12).to(device)
            assert float(travel[seen].min()) >= 0.5, "a gradient above eps moves its parameter"


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"step": 0}, "step"),
        ({"beta2": 0.94}, "beta2"),
        ({"beta2": 1.0}, "beta2"),
        ({"beta2": float("nan")}, "beta2"),
        ({"visible": torch.ones(5, dtype=torch.bool)}, "last_step"),
        ({"dtype": torch.float64}, "params"),
    ],
)
def test_bad_input_is_named(change: dict[str, Any], named: str) -> None:
    dtype = change.pop("dtype", torch.float32)
    x = [torch.zeros(5, 3, dtype=dtype)]
    arguments = {"step": 1, **change}
    with pytest.raises((TypeError, ValueError), match=f"^{named}"):
        ops.adam_(x, x, x, x, [0.1], backend="cpu", **arguments)


@pytest.mark.parametrize("beta2", [0.94, 1.0, float("nan")])
def test_rates_refuse_a_factor_that_no_backend_can_follow(beta2: float) -> None:
    with pytest.raises(ValueError, match=r"^beta2: expected at least 0\.95 and less than 1"):
        Rates(1.0, 1.0, 1.0, 1.0, 1.0, 1.0, beta2)
