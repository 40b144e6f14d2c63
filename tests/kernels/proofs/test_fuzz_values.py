"""Fuzzing of loss and knn: values, sizes and masks drawn by hypothesis.

Proven for every build: the definition's value within the bounds of test_loss and test_knn, where these are derived;
nothing comes out as NaN; the same bits come out again and in any order of the rows. Adam is fuzzed in test_adam.
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


@st.composite
def points(draw: st.DrawFn) -> Tensor:
    """Points in clusters of any size, some of them the same, some on a line or in a plane, anywhere."""
    g = torch.Generator().manual_seed(draw(SEED))
    clusters = []
    for _ in range(draw(st.integers(1, 3))):
        count = draw(st.sampled_from([2, 3, 4, 5, 16, 17, 100]))
        flat = torch.tensor(draw(st.tuples(*[st.sampled_from([0.0, 1.0])] * 3)))
        centre = 10.0 ** draw(st.floats(-4, 4)) * torch.randn(3, generator=g)
        cluster = centre + 10.0 ** draw(st.floats(-6, 4)) * flat * torch.randn(count, 3, generator=g)
        clusters += [cluster, cluster[: draw(st.integers(0, 4))]]
    return torch.cat(clusters)


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
