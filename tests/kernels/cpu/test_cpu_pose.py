"""The fused step's gradient to a motion of the camera is that of the ops and of the float64 definition, on every build.

Not proven here: that a pose refinement built on it converges.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest
import torch
from _studies.stability.roundings import inexact_exponential
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.cpu import isa
from splatmill_worker.kernels.cpu.step import Step
from splatmill_worker.kernels.records import Rates
from splatmill_worker.splat.motion import motion
from tests.support.kernels.alone import Change, rounding, spread
from tests.support.kernels.bounds import SUM_LIMIT, within
from tests.support.kernels.cases import GROUPS, Case, scene
from tests.support.kernels.proof import use
from tests.support.kernels.units import DRAWS, moved_leaf

STILL = Rates(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def slopes(case: Case) -> list[Tensor]:
    g = torch.Generator().manual_seed(3)
    h, w = case.height, case.width
    return [torch.randn(h, w, *more, generator=g) for more in ((3,), (), ())]


def by_ops(case: Case, backend: ops.Backend, dtype: torch.dtype, change: Change = lambda x: x) -> Tensor:
    """The gradient to a motion by the separate ops, with every input changed."""
    xi = torch.zeros(6, dtype=dtype, requires_grad=True)
    groups = [moved_leaf(k, x, change) for k, x in zip(GROUPS, case.groups(dtype), strict=True)]
    viewmat, K = change(case.viewmat.to(dtype)), change(case.K.to(dtype))
    p = replace(case, K=K).project(groups, motion(xi) @ viewmat, backend)
    bins = ops.bin(p, case.width, case.height, backend=backend)
    image = ops.composite(p, bins, case.width, case.height, backend=backend)
    torch.autograd.backward(image, [change(s.to(dtype)) for s in slopes(case)])
    assert xi.grad is not None
    return xi.grad


def unit_of(case: Case, exact: Tensor) -> Tensor:
    """What rounding the inputs and the error of 2^x do to the gradient."""
    g, moved = rounding()

    def exponential(sign: float) -> Tensor:
        with inexact_exponential(g, sign):
            return by_ops(case, "reference", torch.float64)

    return spread(
        {"pose": exact},
        ({"pose": by_ops(case, "reference", torch.float64, moved)} for _ in range(DRAWS)),
        ({"pose": exponential(sign)} for sign in (1.0, 0.0, 0.0)),
    )["pose"]


def by_step(case: Case, threads: int = 2) -> Tensor:
    step = Step(*case.groups(), threads=threads)
    step.forward(*case.camera(), case.width, case.height, degree=case.degree, antialias=case.antialias)
    step.backward_update(*slopes(case), rates=STILL, step=1, pose_gradient=True)
    assert step.pose_gradient is not None
    return step.pose_gradient


@pytest.mark.parametrize("build", isa.supported())
@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("degree", [0, 3])
def test_it_is_that_of_the_ops_and_of_the_definition(degree: int, antialias: bool, build: str) -> None:
    case = replace(scene("pose", 150), degree=degree, antialias=antialias)
    exact, unit = known(degree, antialias)
    with use(f"cpu:{build}") as op:
        fused, separate = by_step(case), by_ops(case, op, torch.float32)
    what = f"degree {degree}{', antialias' if antialias else ''}"
    within("pose, fused", what, (fused.double() - exact)[None], unit[None], SUM_LIMIT)
    within("pose, separate ops", what, (separate.double() - exact)[None], unit[None], SUM_LIMIT)


@cache
def known(degree: int, antialias: bool) -> tuple[Tensor, Tensor]:
    """The exact gradient and its unit, once for all builds."""
    case = replace(scene("pose", 150), degree=degree, antialias=antialias)
    exact = by_ops(case, "reference", torch.float64)
    return exact, unit_of(case, exact)


def test_every_gaussian_of_many_counts_once() -> None:
    """More than one task updates: 256 belong to each."""
    case = scene("pose of many", 700)
    fused, separate = by_step(case), by_ops(case, "cpu", torch.float32)
    assert (fused - separate).norm() <= 1e-4 * separate.norm()


def test_the_loss_falls_along_it_by_its_length() -> None:
    """A photo taken from elsewhere: a motion h along the unit gradient changes the step's own loss by h |gradient|."""
    case = scene("pose photo", 150)
    viewmat, K = case.camera()
    elsewhere = motion(torch.tensor([0.02, -0.01, 0.03, 0.004, 0.006, -0.01])) @ viewmat
    taker = Step(*case.groups())
    color, _, _ = taker.forward(elsewhere, K, case.width, case.height, degree=3)
    photo = (color.clamp(0, 1) * 255).round().to(torch.uint8)

    def loss_at(h: float) -> tuple[float, Tensor]:
        step = Step(*case.groups())
        result = step.train(
            motion(h * direction) @ viewmat, K, photo, degree=3, rates=STILL, step=1, pose_gradient=True
        )
        assert step.pose_gradient is not None
        return result.loss, step.pose_gradient

    direction = torch.zeros(6)
    gradient = loss_at(0.0)[1]
    direction = -gradient / gradient.norm()
    h = 4e-4
    fall = (loss_at(-h)[0] - loss_at(h)[0]) / (2 * h)
    # L1 has kinks where a pixel's difference changes sign; a few of eight thousand values do within 4e-4.
    assert fall == pytest.approx(float(gradient.norm()), rel=0.02)


@pytest.mark.parametrize("gaussians", [15, 17, 1000])
def test_same_bytes_on_any_number_of_threads(gaussians: int) -> None:
    case = scene("pose threads", gaussians, width=130, height=70, seed=gaussians)
    first, *others = (by_step(case, threads) for threads in (1, 2, 3))
    assert first.abs().max() > 0
    for other in others:
        assert torch.equal(first, other)


def test_asking_for_it_changes_nothing_else() -> None:
    case = scene("pose apart", 70)
    rates = Rates(1e-3, 5e-3, 1e-3, 5e-2, 2.5e-3, 1.25e-4)
    asked, plain = (Step(*case.groups()) for _ in range(2))
    for step in (asked, plain):
        step.forward(*case.camera(), case.width, case.height, degree=3)
        step.backward_update(*slopes(case), rates=rates, step=1, pose_gradient=step is asked)
    assert torch.equal(asked.blocks, plain.blocks)
    assert plain.pose_gradient is None
