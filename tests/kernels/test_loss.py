"""L1 + D-SSIM and its gradient: every backend against the float64 definition, and the definition against a plain
window sum.

The order of the definition's gradient is measured in test_reference_order.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import pytest
import torch
from torch import Tensor

from splatmill_worker.kernels import ops, reference
from splatmill_worker.kernels.cpu import isa
from tests.support.kernels.alone import loss_units
from tests.support.kernels.bounds import SUM_LIMIT, within
from tests.support.kernels.proof import EPS, backends, use, where

SIZES = [(1, 1), (15, 16), (17, 257), (257, 1), (40, 33), (23, 1100)]


def pair(height: int, width: int, kind: str = "noise") -> tuple[Tensor, Tensor]:
    g = torch.Generator().manual_seed(height * 1000 + width)
    photo = torch.randint(0, 256, (height, width, 3), dtype=torch.uint8, generator=g)
    color = torch.rand(height, width, 3, generator=g) * 1.2 - 0.1
    if kind == "flat":  # a saturated sky: no variance, where SSIM's constants alone decide
        photo, color = torch.full_like(photo, 255), torch.full_like(color, 0.97)
    if kind == "black":
        photo = torch.zeros_like(photo)
    if kind == "equal":
        color = photo.float() / 255
    return color, photo


def half_mask(height: int, width: int) -> Tensor:
    g = torch.Generator().manual_seed(7)
    mask = (torch.rand(height, width, generator=g) > 0.4).to(torch.uint8) * 255
    mask[0, 0] = 1
    return mask


@pytest.mark.parametrize("backend", backends())
@pytest.mark.parametrize("masked", [False, True], ids=["whole", "masked"])
@pytest.mark.parametrize("kind", ["noise", "flat", "black", "equal"])
@pytest.mark.parametrize("size", SIZES, ids=lambda s: f"{s[0]}x{s[1]}")
def test_loss_is_the_definitions(size: tuple[int, int], kind: str, masked: bool, backend: str) -> None:
    color, photo = pair(*size, kind)
    mask = half_mask(*size) if masked else None
    want = color.double().requires_grad_()
    value = reference.loss(want, photo, mask=mask)
    (expected,) = torch.autograd.grad(value, want)
    device = where(backend)
    got = color.to(device).requires_grad_()
    with use(backend) as op:
        mine = ops.loss(got, photo.to(device), mask=None if mask is None else mask.to(device), backend=op)
        (gradient,) = torch.autograd.grad(mine, got)
    exact = {"value": value.detach(), "gradient": expected}
    unit = loss_units(color, photo, mask, exact)
    what = f"{kind}-{'masked' if masked else 'whole'}-{size[0]}x{size[1]}"
    off_value = (mine.detach().cpu().double() - value.detach())[None]
    within("loss", what, off_value, unit["value"][None], SUM_LIMIT)
    off = (gradient.cpu().double() - expected).abs()
    if (
        kind == "equal"
    ):  # on the kink of |x - p| rounding decides a sign: the L1 term, 0.8 / (3 count), comes, goes or turns
        count = 3 * (float((mask != 0).sum()) if mask is not None else photo[..., 0].numel())
        off = torch.minimum(torch.minimum(off, (off - 0.8 / count).abs()), (off - 1.6 / count).abs())
    within("gradient of the loss", what, off.reshape(-1, 3), unit["gradient"].reshape(-1, 3))
    if mask is not None:
        assert (gradient.cpu()[mask == 0] == 0).all()


def gradient_of(color: Tensor, photo: Tensor, backend: ops.Backend) -> tuple[float, Tensor]:
    leaf = color.clone().requires_grad_()
    value = ops.loss(leaf, photo, backend=backend)
    return float(value.detach()), torch.autograd.grad(value, leaf)[0].double()


@cache
def nearly_learnt(contrast: float) -> tuple[Tensor, Tensor, float, Tensor, float]:
    """A bright picture, colours 0.02 off it, the loss, its gradient, and the root mean square of what half-ulp changes
    of the colours do to that."""
    g = torch.Generator().manual_seed(0)
    photo = (245 + contrast * torch.randn(48, 64, 3, generator=g)).round().clamp(0, 255).to(torch.uint8)
    color = (photo.float() / 255 + 0.02 * torch.randn(48, 64, 3, generator=g)).clamp(0, 1.2)
    value, exact = gradient_of(color.double(), photo, "reference")
    moved = []
    for _ in range(2):
        half_ulp = (torch.rand(color.shape, generator=g, dtype=torch.float64) * 2 - 1) * EPS
        moved.append(gradient_of(color.double() * (1 + half_ulp), photo, "reference")[1] - exact)
    return color, photo, value, exact, float(torch.stack(moved).square().mean().sqrt())


@pytest.mark.parametrize(
    "backend", [*(f"cpu:{build}" for build in isa.supported()), "gpu"]
)  # or its interpreter
@pytest.mark.parametrize("contrast", [0, 1, 20])
def test_bright_pictures_keep_the_digits_of_their_differences(contrast: float, backend: str) -> None:
    """The variance of bright, even colours as E[x^2] - E[x]^2 has an error of 8 to 24 units of conditioning."""
    if backend == "gpu":
        pytest.importorskip("triton", reason="Triton comes with torch's GPU builds; pip install triton")
    color, photo, value, exact, unit = nearly_learnt(contrast)
    device = where(backend)
    with use(backend) as op:
        mine, gradient = gradient_of(color.to(device), photo.to(device), op)
    off = (gradient.cpu() - exact).abs()
    turned = off > 0.5 * 0.8 / color.numel()  # where rounding decides the sign of |x - p|
    assert int(turned.sum()) <= 2
    # Measured: 1.0 unit, which is the rounding of x - p.
    assert float(off[~turned].square().mean().sqrt()) <= 2 * unit
    assert mine == pytest.approx(value, rel=1e-6)


@pytest.mark.parametrize("backend", backends())
def test_what_a_mask_hides_does_not_matter(backend: str) -> None:
    color, photo = pair(40, 33)
    mask = half_mask(40, 33)
    hidden = mask == 0
    poisoned, other = color.clone(), photo.clone()
    poisoned[hidden], other[hidden] = float("nan"), 77
    device = where(backend)
    results = []
    with use(backend) as op:
        for c, p in ((color, photo), (poisoned, other)):
            leaf = c.to(device).requires_grad_()
            value = ops.loss(leaf, p.to(device), mask=mask.to(device), backend=op)
            results.append((value.detach(), torch.autograd.grad(value, leaf)[0]))
    assert torch.equal(results[0][0], results[1][0])
    assert torch.equal(results[0][1], results[1][1])


@pytest.mark.parametrize("backend", ["reference", *backends()])
def test_an_empty_mask_gives_zero(backend: str) -> None:
    color, photo = pair(20, 20)
    device = where(backend)
    leaf = color.to(device).requires_grad_()
    with use(backend) as op:
        value = ops.loss(
            leaf, photo.to(device), mask=torch.zeros(20, 20, dtype=torch.bool, device=device), backend=op
        )
        (gradient,) = torch.autograd.grad(value, leaf)
    assert float(value.detach()) == 0.0
    assert (gradient == 0).all()


@pytest.mark.parametrize("backend", [b for b in backends() if str(b).startswith("cpu")])
def test_kept_statistics_and_threads_change_nothing(backend: str) -> None:
    color, photo = pair(97, 600)
    mask = half_mask(97, 600)
    results = []
    before = torch.get_num_threads()
    try:
        with use(backend) as op:
            kept = ops.photo_stats(photo, mask=mask, backend=op)
            for threads, stats in ((1, None), (2, kept), (1, kept)):
                torch.set_num_threads(threads)
                leaf = color.clone().requires_grad_()
                value = ops.loss(leaf, photo, mask=mask, stats=stats, backend=op)
                results.append((value.detach(), torch.autograd.grad(value, leaf)[0]))
    finally:
        torch.set_num_threads(before)
    for value, gradient in results[1:]:
        assert torch.equal(value, results[0][0])
        assert torch.equal(gradient, results[0][1])


def test_the_definition_is_wangs() -> None:
    """SSIM by a plain sum over the 11 x 11 window at one pixel near a corner, and L1, by hand."""
    color, photo = pair(14, 13)
    x, p = color.double(), photo.double() / 255
    w = [math.exp(-(d * d) / 4.5) for d in range(-5, 6)]
    total = sum(w)
    score = 0.0
    for r in range(14):
        for c in range(13):
            m = torch.zeros(5, 3, dtype=torch.float64)
            for i in range(-5, 6):
                for j in range(-5, 6):
                    if 0 <= r + i < 14 and 0 <= c + j < 13:
                        a, b = x[r + i, c + j], p[r + i, c + j]
                        m += w[i + 5] * w[j + 5] / total**2 * torch.stack([a, b, a * a, b * b, a * b])
            va, vb, co = m[2] - m[0] ** 2, m[3] - m[1] ** 2, m[4] - m[0] * m[1]
            s = (
                (2 * m[0] * m[1] + 1e-4)
                * (2 * co + 9e-4)
                / ((m[0] ** 2 + m[1] ** 2 + 1e-4) * (va + vb + 9e-4))
            )
            score += float(s.mean()) / (14 * 13)
    expected = 0.8 * float((x - p).abs().mean()) + 0.2 * (1 - score)
    assert float(reference.loss(x, photo)) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"photo": torch.zeros(5, 5, 3)}, "photo"),
        ({"photo": torch.zeros(5, 6, 3, dtype=torch.uint8)}, "photo"),
        ({"color": torch.zeros(5, 5)}, "color"),
        ({"color": torch.zeros(5, 5, 3, dtype=torch.float64)}, "color"),
        ({"mask": torch.zeros(5, 5)}, "mask"),
        ({"mask": torch.zeros(4, 5, dtype=torch.bool)}, "mask"),
    ],
)
def test_bad_input_is_named(change: dict[str, Any], named: str) -> None:
    arguments: dict[str, Any] = {
        "color": torch.zeros(5, 5, 3),
        "photo": torch.zeros(5, 5, 3, dtype=torch.uint8),
        "mask": None,
        **change,
    }
    with pytest.raises((TypeError, ValueError), match=f"^{named}"):
        ops.loss(**arguments, backend="cpu")
