"""Fuzzing of loss, adam and knn: values, sizes and masks drawn by hypothesis.

Proven for every build: the definition's value within the bounds of test_loss, test_adam and test_knn, where these are
derived; nothing comes out as NaN; the same bits come out again and in any order of the rows; a bad number stays where
it is. Thousands of steps of Adam are in test_adam.
"""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from splatmill_worker.kernels import ops, reference
from splatmill_worker.kernels.cpu import isa
from tests.support.kernels.alone import loss_units
from tests.support.kernels.bounds import within
from tests.support.kernels.fuzz import inputs, rolled, same_bits
from tests.support.kernels.proof import EPS, use

SIDE = st.sampled_from([1, 2, 5, 11, 15, 16, 17, 33])
SEED = st.integers(0, 2**16)
SHAPES = [(3,), (4,), (), (15, 3)]
RATES = [1.6e-4, 1e-3, 5e-2, 1.25e-4]


@st.composite
def pictures(draw: st.DrawFn) -> tuple[Tensor, Tensor, Tensor | None]:
    """A rendering, a photo, and a mask or none: noise of any strength about any level, or about the same for both."""
    height, width = draw(SIDE), draw(SIDE)
    g = torch.Generator().manual_seed(draw(SEED))
    level, noise = draw(st.floats(0, 1)), draw(st.sampled_from([0.0, 1e-4, 1e-2, 0.3]))
    photo = (255 * (level + noise * torch.randn(height, width, 3, generator=g))).clamp(0, 255).to(torch.uint8)
    other = level if draw(st.booleans()) else draw(st.floats(0, 1))
    color = other + draw(st.sampled_from([1e-5, 1e-3, 0.3])) * torch.randn(height, width, 3, generator=g)
    kept = draw(st.sampled_from([None, 0.0, 0.1, 0.9]))
    mask = None if kept is None else (torch.rand(height, width, generator=g) < kept).to(torch.uint8)
    return color, photo, mask


def loss_of(color: Tensor, photo: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    leaf = color.clone().requires_grad_()
    value = ops.loss(leaf, photo, mask=mask, backend="cpu")
    return value.detach(), torch.autograd.grad(value, leaf)[0]


@pytest.mark.parametrize("build", isa.supported())
@inputs(25)
@given(picture=pictures())
def test_fuzz_loss(build: str, picture: tuple[Tensor, Tensor, Tensor | None]) -> None:
    color, photo, mask = picture
    exact = color.double().requires_grad_()
    want = reference.loss(exact, photo, mask=mask)
    (expected,) = torch.autograd.grad(want, exact)
    with use(f"cpu:{build}"):
        value, gradient = loss_of(color, photo, mask)
        again, same = loss_of(color, photo, mask)
    assert same_bits(value, again)
    assert same_bits(gradient, same)
    unit = loss_units(color, photo, mask, {"value": want.detach(), "gradient": expected})
    # Where both images are nearly the same, 0.2 (1 - SSIM) has the rounding of a number near 1.
    within("fuzz: loss", "fuzz", (value.double() - want.detach())[None], unit["value"][None] + 0.2 * EPS)
    # On the kink of |x - p| rounding decides about the sign of the L1 term.
    certain = (exact.detach() - photo.double() / 255).abs() > 4 * EPS
    off = torch.where(certain, (gradient.double() - expected).abs(), 0.0)
    within("fuzz: gradient of the loss", "fuzz", off.flatten(), unit["gradient"].flatten())
    if mask is not None:
        assert (gradient[mask == 0] == 0).all()
        hidden = torch.where((mask == 0)[..., None], float("nan"), color)
        with use(f"cpu:{build}"):
            value_too, gradient_too = loss_of(hidden, photo, mask)
        assert same_bits(value_too, value)
        assert same_bits(gradient_too, gradient)


State = tuple[list[Tensor], list[Tensor], list[Tensor]]


def stepped(state: State, gradients: list[list[Tensor]]) -> tuple[State, int]:
    """Copies of parameters and moments after a step for each list of gradients, and how many values were refused."""
    params, m, v = ([x.clone() for x in part] for part in state)
    refused = sum(
        ops.adam_(params, g, m, v, RATES, step=t, backend="cpu") for t, g in enumerate(gradients, 1)
    )
    return (params, m, v), refused


def parts(state: State) -> list[Tensor]:
    return [x for part in state for x in part]


@pytest.mark.parametrize("build", isa.supported())
@inputs(20)
@given(
    count=st.sampled_from([1, 2, 15, 16, 17, 40]),
    seed=SEED,
    size=st.floats(-18, 10),
    decades=st.floats(0, 12),
    steps=st.integers(1, 4),
    bad=st.sampled_from([float("nan"), float("inf"), 1e25]),
)
def test_fuzz_adam(
    build: str, count: int, seed: int, size: float, decades: float, steps: int, bad: float
) -> None:
    g = torch.Generator().manual_seed(seed)
    params = [torch.randn(count, *s, generator=g) for s in SHAPES]
    start: State = (params, [torch.zeros_like(p) for p in params], [torch.zeros_like(p) for p in params])
    gradients = [
        [
            torch.randn(count, *s, generator=g)
            * 10.0 ** (size - decades * torch.rand(count, *s, generator=g))
            for s in SHAPES
        ]
        for _ in range(steps)
    ]
    exact = tuple([x.double() for x in part] for part in start)
    for t, grads in enumerate(gradients, 1):
        reference.adam_(exact[0], [x.double() for x in grads], exact[1], exact[2], RATES, step=t)
    with use(f"cpu:{build}"):
        got, refused = stepped(start, gradients)
        again, _ = stepped(start, gradients)
        order = rolled(count)
        turned: State = ([x[order] for x in params], start[1], start[2])
        other, _ = stepped(turned, [[x[order] for x in grads] for grads in gradients])
        # One bad number, in the first step.
        place = seed % params[0].numel()
        gradients[0][0] = gradients[0][0].clone()
        gradients[0][0].view(-1)[place] = bad
        spoilt, counted = stepped(start, gradients)
    assert refused == 0
    assert counted == 1
    # Each step rounds the parameter once and its update, of at most 3.2 rates, to 24 eps; below 1e-15, Adam's eps, the
    # square of a gradient leaves float32 while eps outweighs its root: a thousandth of a rate.
    for p, want, rate in zip(got[0], exact[0], RATES, strict=True):
        bound = steps * (EPS * want.abs() * 2 + (80 * EPS + 1e-3 * (size - decades < -15)) * rate)
        assert ((p.double() - want).abs() <= bound).all()
    for a, b, c in zip(parts(got), parts(again), parts(other), strict=True):
        assert torch.isfinite(a).all()
        assert same_bits(a, b)
        assert same_bits(a[order], c)
    for i, (a, b) in enumerate(zip(parts(spoilt), parts(got), strict=True)):
        assert torch.isfinite(a).all()
        untouched = torch.ones(a.numel(), dtype=torch.bool)
        if i % len(SHAPES) == 0:
            untouched[place] = False
        assert same_bits(a.reshape(-1)[untouched], b.reshape(-1)[untouched])


@st.composite
def points(draw: st.DrawFn) -> Tensor:
    """Points in clusters of any size, some of them the same, some on a line or in a plane, anywhere."""
    g = torch.Generator().manual_seed(draw(SEED))
    found = []
    for _ in range(draw(st.integers(1, 3))):
        count = draw(st.sampled_from([2, 3, 4, 5, 16, 17, 100]))
        flat = torch.tensor(draw(st.tuples(*[st.sampled_from([0.0, 1.0])] * 3)))
        centre = 10.0 ** draw(st.floats(-4, 4)) * torch.randn(3, generator=g)
        cluster = centre + 10.0 ** draw(st.floats(-6, 4)) * flat * torch.randn(count, 3, generator=g)
        found += [cluster, cluster[: draw(st.integers(0, 4))]]
    return torch.cat(found)


@pytest.mark.parametrize("build", isa.supported())
@inputs(25)
@given(cloud=points())
def test_fuzz_knn(build: str, cloud: Tensor) -> None:
    order = rolled(len(cloud))
    with use(f"cpu:{build}"):
        got, again, other = (ops.knn(x, backend="cpu") for x in (cloud, cloud, cloud[order]))
    # As in test_knn: each of ten operations rounds once.
    assert torch.allclose(got.double(), reference.knn(cloud.double()), rtol=16 * EPS, atol=0.0)
    assert same_bits(got, again)
    assert same_bits(got[order], other)
