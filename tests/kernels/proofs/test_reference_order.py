"""The definition's gradients are right: finite differences, and errors that fall as h^2, op by op and group by group.

In float64, with the jump at 1/255 replaced by a smooth ramp and the stop left out. The hard cut itself is covered
where it acts on values (test_proof_forward); its gradient, zero on either side of a jump, has no order to measure.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from splatmill_worker.kernels import reference
from tests.support.kernels.cases import GROUPS, Case, scene

Function = Callable[[dict[str, Tensor]], Tensor]


def smooth_scene(degree: int) -> Case:
    """No kink within reach: colours well above 0, alphas below 0.9, depths apart, Gaussians inside the view."""
    case = scene("smooth", 24, width=24, height=20, degree=degree, seed=40)
    case.means[:, :2] *= 0.4
    case.means[:, 2] = torch.linspace(-0.8, 0.8, 24)
    case.means[:] = (case.means - case.viewmat[:3, 3] + torch.tensor([0, 0, 3.0])) @ case.viewmat[:3, :3]
    case.logit_opacities.clamp_(-1.5, 1.5)
    case.sh[:, 0].clamp_(0.5, 2.0)
    case.sh[:, 1:] *= 0.3
    return case


def readout(*images: Tensor) -> Tensor:
    """A smooth, curved number made of images: weights that differ at every pixel, plus squares."""
    total = torch.zeros((), dtype=torch.float64)
    for i, x in enumerate(images):
        w = torch.randn(x.shape, generator=torch.Generator().manual_seed(50 + i), dtype=torch.float64)
        total = total + (w * x).sum() + 0.5 * (x * x).sum()
    return total


def whole(case: Case) -> tuple[Function, dict[str, Tensor]]:
    """project, bin and composite, from the parameters and the camera."""
    leaves = {
        **dict(zip(GROUPS, case.groups(torch.float64), strict=True)),
        "viewmat": case.camera(torch.float64)[0],
    }
    leaves["background"] = case.background.double()

    def f(x: dict[str, Tensor]) -> Tensor:
        p = case.project([x[k] for k in GROUPS], x["viewmat"], "reference")
        bins = reference.bin(p, case.width, case.height)
        return readout(
            *reference.composite(p, bins, case.width, case.height, background=x["background"], _soft_cut=True)
        )

    return f, leaves


def projecting(case: Case) -> tuple[Function, dict[str, Tensor]]:
    leaves = {
        **dict(zip(GROUPS, case.groups(torch.float64), strict=True)),
        "viewmat": case.camera(torch.float64)[0],
    }

    def f(x: dict[str, Tensor]) -> Tensor:
        p = case.project([x[k] for k in GROUPS], x["viewmat"], "reference")
        return readout(p.means2d / 10, *p[1:5])

    return f, leaves


def compositing(case: Case) -> tuple[Function, dict[str, Tensor]]:
    p = case.project(case.groups(torch.float64), case.viewmat.double(), "reference")
    leaves = {k: x.detach() for k, x in zip(p._fields[:5], p, strict=False)}
    bins = reference.bin(p, case.width, case.height)

    def f(x: dict[str, Tensor]) -> Tensor:
        moved = p._replace(**x)
        return readout(*reference.composite(moved, bins, case.width, case.height, _soft_cut=True))

    return f, leaves


def losing(masked: bool) -> tuple[Function, dict[str, Tensor]]:
    g = torch.Generator().manual_seed(60)
    photo = torch.randint(0, 256, (20, 24, 3), dtype=torch.uint8, generator=g)
    mask = torch.rand(20, 24, generator=g) > 0.3 if masked else None
    # No value on the kink of |x - p|: at least 1e-2 away from it.
    color = torch.rand(20, 24, 3, generator=g, dtype=torch.float64)
    color = color + 0.05 * torch.sign(color - photo.double() / 255)
    return (lambda x: 100 * reference.loss(x["color"], photo, mask=mask)), {"color": color}


def problems() -> list[object]:
    made: list[tuple[str, tuple[Function, dict[str, Tensor]]]] = [
        *((f"whole, degree {d}", whole(smooth_scene(d))) for d in (0, 3)),
        *((f"project, degree {d}", projecting(smooth_scene(d))) for d in (1, 2, 3)),
        ("composite", compositing(smooth_scene(3))),
        ("loss", losing(False)),
        ("loss, masked", losing(True)),
    ]
    return [pytest.param(f, leaves, k, id=f"{name}: {k}") for name, (f, leaves) in made for k in leaves]


def direction(leaves: dict[str, Tensor], group: str) -> Tensor:
    d = torch.randn(leaves[group].shape, generator=torch.Generator().manual_seed(70), dtype=torch.float64)
    if group == "viewmat":
        d = d * 0.1
        d[3] = 0.0
    unit: Tensor = d / d.norm()
    return unit


@pytest.mark.parametrize(("f", "leaves", "group"), problems())
def test_the_gradient_has_order_two(f: Function, leaves: dict[str, Tensor], group: str) -> None:
    x = {k: v.clone().requires_grad_() for k, v in leaves.items()}
    value = f(x)
    (g,) = torch.autograd.grad(value, x[group])
    d = direction(leaves, group)
    slope = float((g * d).sum())
    assert slope != 0.0
    steps = [2.0**-k * 0.02 for k in range(6)]
    with torch.no_grad():
        left = [abs(float(f({**leaves, group: leaves[group] + h * d}) - value) - h * slope) for h in steps]
    floor = 1e-13 * (abs(float(value.detach())) + 1.0)  # rounding of f itself
    orders = [torch.log2(torch.tensor(a / b)).item() for a, b in itertools.pairwise(left) if b > 30 * floor]
    if not orders:  # linear in this group: nothing is left but rounding
        assert max(left) <= 30 * floor
        return
    assert sorted(orders)[len(orders) // 2] == pytest.approx(2.0, abs=0.15), f"{left}"


@pytest.mark.parametrize(("f", "leaves", "group"), problems())
def test_the_gradient_is_the_finite_difference(f: Function, leaves: dict[str, Tensor], group: str) -> None:
    """Entry by entry, central differences at a dozen places; error h^2/6 |f'''| plus 2e-16 |f| / h, with h = 1e-5."""
    x = {k: v.clone().requires_grad_() for k, v in leaves.items()}
    value = f(x)
    (g,) = torch.autograd.grad(value, x[group])
    flat = g.flatten()
    places = torch.randperm(flat.numel(), generator=torch.Generator().manual_seed(80))[:12].tolist()
    h = 1e-5
    for i in places:
        if group == "viewmat" and i >= 12:
            continue  # the bottom row 0 0 0 1 is not read
        e = torch.zeros(flat.numel(), dtype=torch.float64)
        e[i] = h
        e = e.reshape(g.shape)
        with torch.no_grad():
            up, down = f({**leaves, group: leaves[group] + e}), f({**leaves, group: leaves[group] - e})
        difference = float(up - down) / (2 * h)
        assert difference == pytest.approx(float(flat[i]), rel=1e-5, abs=1e-7 * (1 + float(flat.abs().max())))


def test_antialias_compensation_is_detached() -> None:
    """Scales and rotations get the gradient they would have were the compensation a constant."""
    case = smooth_scene(0)
    leaves = [x.requires_grad_() for x in case.groups(torch.float64)]
    p = replace(case, antialias=True).project(leaves, case.viewmat.double(), "reference")
    plain = case.project(leaves, case.viewmat.double(), "reference")
    assert (p.opacities < plain.opacities).all()
    grads = torch.autograd.grad(p.opacities.sum(), leaves, allow_unused=True, materialize_grads=True)
    for name, g in zip(GROUPS, grads, strict=True):
        assert bool((g != 0).any()) == (name == "logit_opacities")
