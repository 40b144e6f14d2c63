"""Fuzzing of project, bin, composite and the fused step: extreme Gaussians and cameras drawn by hypothesis.

Proven for every build: images and gradients are the definition's within what rounding explains (`units`), pairs are
missing only where rounding decides; nothing comes out as NaN; the same bits come out again, on two threads, and in any
order of the Gaussians; a poisoned Gaussian leaves the others as they are without it. Where a whole Gaussian lies
within rounding of a decision (the order of depths, the near plane, the bounds of the Jacobian) nothing is compared.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import assume, example, given
from hypothesis import strategies as st
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.cpu import isa
from splatmill_worker.kernels.cpu.step import Step
from splatmill_worker.kernels.records import Projected, Rates
from tests.support.kernels.bounds import within
from tests.support.kernels.cases import GROUPS, Case
from tests.support.kernels.exact import exact_of
from tests.support.kernels.fuzz import cases, inputs, reordered, rolled, same_bits, sure
from tests.support.kernels.proof import EPS, conditioning, peak, record_error, run, use
from tests.support.kernels.units import IMAGES

RATES = Rates(1.6e-4, 5e-3, 1e-3, 5e-2, 2.5e-3, 1.25e-4)
Outputs = dict[str, Tensor]


def weights(case: Case) -> list[Tensor]:
    g = torch.Generator().manual_seed(3)
    return [torch.randn(case.height, case.width, *s, generator=g) for s in ((3,), (), ())]


def by_ops(case: Case) -> Outputs:
    """What project, bin and composite return, and the gradients of the images' weighted sum."""
    got = run(case, "cpu")
    images = zip(IMAGES, (got.color, got.alpha, got.depth), strict=True)
    fields = {f"projected {k}": x for k, x in got.projected._asdict().items()}
    return {**fields, **dict(images), **got.gradients(*weights(case))}


def by_step(case: Case, threads: int = 1) -> Outputs:
    """The fused step's images and gradients, and its parameters and loss after three steps on a photo."""
    step = Step(*case.groups(), threads=threads)
    options: dict[str, Any] = {
        "degree": case.degree,
        "background": case.background,
        "antialias": case.antialias,
    }
    camera = (*case.camera(), case.width, case.height)
    images = step.forward(*camera, **options)
    outputs = {k: x.clone() for k, x in zip(IMAGES, images, strict=True)}
    outputs |= step.gradients(*weights(case))
    g = torch.Generator().manual_seed(4)
    photo = torch.randint(0, 256, (case.height, case.width, 3), dtype=torch.uint8, generator=g)
    for t in range(1, 4):
        result = step.train(*case.camera(), photo, rates=RATES, step=t, pose_gradient=True, **options)
        outputs[f"loss {t}"] = torch.tensor(result.loss)
        assert step.pose_gradient is not None
        outputs[f"pose {t}"] = step.pose_gradient.clone()
    moved = {f"moved {k}": x for k, x in step.parameters().items()}
    return {**outputs, **moved, "score": step.plain_sum.clone()}


def rows(outputs: Outputs, count: int) -> set[str]:
    """The outputs that have a row for each Gaussian."""
    names = {*GROUPS, "score", *(f"moved {k}" for k in GROUPS)}
    return {k for k in outputs if k in names or k.startswith("projected")}


@pytest.mark.slow
@pytest.mark.parametrize("build", isa.supported())
@inputs(8)
@given(case=cases())
def test_fuzz_images_and_gradients_are_the_definitions(build: str, case: Case) -> None:
    assume(sure(case))
    known = exact_of(case)
    sure_pixels = ~known.undecided
    want = (known.want.color, known.want.alpha, known.want.depth)
    with use(f"cpu:{build}"):
        step = Step(*case.groups())
        options: dict[str, Any] = {
            "degree": case.degree,
            "background": case.background,
            "antialias": case.antialias,
        }
        images = step.forward(*case.camera(), case.width, case.height, **options)
        for label, got, other in zip(IMAGES, images, want, strict=True):
            off = (got.double() - other.detach()).abs()
            within(f"fused, {label}", "fuzz", off[sure_pixels], known.units.fused[label][sure_pixels])
        gradients = step.gradients(*known.weights)
        for k in GROUPS:
            error = gradients[k].double() - known.gradients[k]
            within(f"fused, gradient to {k}", "fuzz", error, known.units.fused[k])
        # The separate ops pass conics on, whose numbers move by sqrt(3) eps each (`units`). Where that may take the
        # determinant to 0, there is no Gaussian, and no unit.
        if float(conditioning(known.want.projected).max()) * 4 * math.sqrt(3) * EPS >= 1:
            return
        chain = run(case, "cpu")
        for label, got, other in zip(IMAGES, (chain.color, chain.alpha, chain.depth), want, strict=True):
            off = (got.detach().double() - other.detach()).abs()
            within(label, "fuzz", off[sure_pixels], known.units.separate[label][sure_pixels])
        separate = chain.gradients(*known.weights)
        for k in GROUPS:
            error = separate[k].double() - known.gradients[k]
            within(f"gradient to {k}", "fuzz", error, known.units.separate[k])


LOST_DETERMINANT = Case(
    "a needle at the near plane, whose conic has a determinant below zero once a build without fma rounds it",
    means=torch.tensor([[0.039392512, 0.154390723, -0.021188552]]),
    log_scales=torch.tensor([[-1.8554672, -12.055163383, -22.108175278]]),
    quats=torch.tensor([[0.423942149, 0.431425124, 0.795829296, 0.028304063]]),
    logit_opacities=torch.tensor([15.783547401]),
    sh=torch.zeros(1, 16, 3),
    viewmat=torch.tensor(
        [
            [0.99969846, -0.013095734, -0.020772252, 0.028235268],
            [0.012933107, 0.999884784, -0.007944175, -0.02352939],
            [0.020873893, 0.00767313, 0.9997527, 0.029176442],
            [0.0, 0.0, 0.0, 1.0],
        ]
    ),
    K=torch.tensor([[3613.552246, 0.0, -3154.220947], [0.0, 2890.841797, 48.33679581], [0.0, 0.0, 1.0]]),
    width=17,
    height=15,
    degree=0,
)


@pytest.mark.parametrize("build", isa.supported())
@inputs(15)
@given(case=cases())
@example(case=LOST_DETERMINANT)
def test_fuzz_no_pair_that_reaches_a_pixel_is_missing(build: str, case: Case) -> None:
    """`bin` alone: both backends read the same projected Gaussians."""
    with use(f"cpu:{build}"):
        projected = Projected(*(x.detach() for x in run(case, "cpu").projected))
        mine = ops.bin(projected, case.width, case.height, backend="cpu")
        again = ops.bin(projected, case.width, case.height, backend="cpu")
    assert all(map(torch.equal, mine, again))
    exact = Projected(*(x.double() for x in projected))
    theirs = ops.bin(exact, case.width, case.height, backend="reference")
    least = torch.exp(record_error(projected)) / 255
    for tile in range(len(mine.offsets) - 1):
        listed, needed = (
            b.ids[b.offsets[tile] : b.offsets[tile + 1]].long().tolist() for b in (mine, theirs)
        )
        for i in set(needed) - set(listed):
            assert peak(exact, i, tile, case.width) <= float(least[i])
        order = [(float(projected.depths[i]), i) for i in listed]
        assert order == sorted(order), "front to back, ties by index"
        assert len(set(listed)) == len(listed)


@pytest.mark.parametrize("build", isa.supported())
@inputs(12)
@given(case=cases())
def test_fuzz_finite_in_finite_out_and_the_same_again(build: str, case: Case) -> None:
    with use(f"cpu:{build}"):
        ours, fused = by_ops(case), by_step(case)
        for outputs in (ours, fused):
            for k, x in outputs.items():
                assert torch.isfinite(x).all(), k
        for again in (by_ops(case), by_step(case), by_step(case, threads=2)):
            for k, x in again.items():
                assert same_bits(x, (ours if again.keys() == ours.keys() else fused)[k]), k


@pytest.mark.parametrize("build", isa.supported())
@inputs(25)
@given(case=cases(most=6))
def test_fuzz_the_order_of_gaussians_does_not_show(build: str, case: Case) -> None:
    order = rolled(len(case.means))
    with use(f"cpu:{build}"):
        depths = run(case, "cpu").projected.depths.detach()
        drawn = depths[depths > 0]
        assume(len(drawn.unique()) == len(drawn))  # equal depths are blended by index
        for by in (by_ops, by_step):
            want, got = by(case), by(reordered(case, order))
            for k in want:
                if k in rows(want, len(order)):
                    assert same_bits(got[k], want[k][order]), k
                elif k in IMAGES:
                    assert same_bits(got[k], want[k]), k


@pytest.mark.parametrize("build", isa.supported())
@inputs(25)
@given(
    case=cases(most=6),
    group=st.sampled_from(GROUPS),
    value=st.sampled_from([float("nan"), float("inf"), -float("inf")]),
    slot=st.integers(0, 47),
)
def test_fuzz_a_poisoned_gaussian_leaves_the_others(
    build: str, case: Case, group: str, value: float, slot: int
) -> None:
    count = len(case.means)
    assume(count > 1)
    x = getattr(case, group).clone()
    read = 3 * (case.degree + 1) ** 2 if group == "sh" else x[0].numel()
    x.view(count, -1)[0, slot % read] = value
    poisoned = replace(case, **{group: x})
    without = reordered(case, torch.arange(1, count))
    with use(f"cpu:{build}"):
        for by in (by_ops, by_step):
            want, got = by(without), by(poisoned)
            for k in want:
                if k in rows(want, count):
                    assert same_bits(got[k][1:], want[k]), k
                    if not k.startswith("moved"):
                        assert (got[k][0] == 0).all(), k
                elif k in IMAGES or k.startswith("loss"):
                    assert same_bits(got[k], want[k]), k
