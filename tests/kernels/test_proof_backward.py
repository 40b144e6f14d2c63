"""Every backend differentiates every case as the definition does: the chain of ops, and project and composite alone.

The definition is the float64 reference; that its gradient is right is shown by test_reference_order. Every Gaussian's
gradient is compared in units of what rounding does to it (`units`); a norm over all would hide one. Pixels within
the error of float32 of a threshold get no weight here, since the gradient jumps there; test_proof_forward shows that
they are few.
"""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.records import Projected
from tests.support.kernels.bounds import within
from tests.support.kernels.cases import CASES, GROUPS
from tests.support.kernels.exact import exact, image_weights
from tests.support.kernels.proof import (
    EPS,
    Run,
    alpha_error,
    backends,
    define,
    filled,
    run,
    use,
    weighted,
)


@pytest.mark.parametrize("backend", backends())
@pytest.mark.parametrize("name", CASES)
def test_gradient_is_the_definitions(name: str, backend: str) -> None:
    known = exact(name)
    case, want = known.case, known.want
    with use(backend) as op:
        got = run(case, op).gradients(*known.weights)
    for k, b in known.gradients.items():
        a, unit = got[k].cpu().double(), known.units.separate[k]
        assert torch.isfinite(a).all(), k
        # The gradients to the camera and the background are one vector each; all others have a row for every Gaussian.
        alone = k not in GROUPS
        within(f"gradient to {k}", name, (a - b)[None] if alone else a - b, unit[None] if alone else unit)
    culled = (want.projected.extents == 0).all(1)
    for k in GROUPS:
        assert (got[k].cpu()[culled] == 0).all(), f"{k}: a culled Gaussian has no gradient"
    unread = (case.degree + 1) ** 2
    assert (got["sh"].cpu()[:, unread:] == 0).all()


ALONE = [
    "ordinary",
    "degree 1",
    "antialias",
    "needles 1e+04",
    "discs",
    "near plane",
    "far off-axis",
    "dark",
    "portrait",
]


@pytest.mark.parametrize("backend", backends())
@pytest.mark.parametrize("name", ALONE)
def test_project_alone(name: str, backend: str) -> None:
    """Weights on project's own fields: means2d, conics, opacities, colours, depths."""
    case = CASES[name]()

    def gradients(op: ops.Backend, dtype: torch.dtype) -> dict[str, Tensor]:
        device = "cuda" if op == "gpu" and torch.cuda.is_available() else "cpu"
        leaves = [x.to(device).requires_grad_() for x in (*case.groups(dtype), case.camera(dtype)[0])]
        p = case.project(leaves[:5], leaves[5], op)
        g = torch.Generator().manual_seed(6)
        total = torch.zeros((), dtype=dtype, device=device)
        for field in p[:5]:
            total = total + (field * torch.randn(field.shape, generator=g).to(device, dtype)).sum()
        return dict(zip((*GROUPS, "viewmat"), torch.autograd.grad(total, leaves), strict=True))

    expected = gradients("reference", torch.float64)
    with use(backend) as op:
        got = gradients(op, torch.float32)
    # Every factor of the chain rule carries a few eps, and 1/z carries the error of the camera coordinate, to the
    # third power at most. Between the two axes of a conic terms cancel in proportion to their ratio, the root of its
    # condition.
    p = define(case).projected
    z = torch.where(p.depths > 0, p.depths, 1.0).detach()
    coordinate = 4 * EPS * (case.means.double().abs().sum(1) + case.viewmat[:3, 3].double().abs().sum())
    seen = p.depths > 0
    axes = float(condition(p.conics.detach()[seen]).max().sqrt())
    relative = (64 * EPS + 3 * float((coordinate / z)[seen].max())) * (1 + axes)
    # A round Gaussian's quaternion gradient is a difference of equal terms.
    floor = float(expected["log_scales"].norm()) / float(case.quats.norm(dim=1).min())
    for k, b in expected.items():
        size = float(b.norm()) + (floor if k == "quats" else 0.0)
        assert float((got[k].cpu().double() - b).norm()) <= relative * size + 1e-12, k


def condition(conics: Tensor) -> Tensor:
    """Ratio of the larger to the smaller eigenvalue of each conic."""
    a, b, c = conics.double().unbind(1)
    root = torch.sqrt(((a - c) / 2) ** 2 + b * b)
    low = (a + c) / 2 - root
    return torch.where(low > 0, ((a + c) / 2 + root) / low.clamp_min(1e-30), 1.0)


@pytest.mark.parametrize("backend", backends())
@pytest.mark.parametrize(
    "name", ["ordinary", "degree 1", "needles 1e+02", "sub-pixel", "pile of opaque", "dark", "portrait"]
)
def test_composite_alone(name: str, backend: str) -> None:
    """The same rounded splats given to both: images and gradients to every field of them."""
    case = CASES[name]()
    want = define(case)
    rounded = Projected(*(x.detach().float() for x in want.projected))
    # A conic's smaller eigenvalue, recovered from three float32 numbers, is known to condition * 4 eps.
    error = alpha_error(case, want.projected) + 5.5 * 4 * EPS * condition(rounded.conics)

    def through(op: ops.Backend, dtype: torch.dtype) -> tuple[tuple[Tensor, Tensor, Tensor], list[Tensor]]:
        device = "cuda" if op == "gpu" and torch.cuda.is_available() else "cpu"
        fields = [x.to(device, dtype).requires_grad_() for x in rounded[:5]]
        p = filled(rounded, fields)
        bins = ops.bin(p, case.width, case.height, backend=op)
        image = ops.composite(p, bins, case.width, case.height, backend=op)
        return image, fields

    image, fields = through("reference", torch.float64)
    near = Run({}, filled(rounded, fields), want.bins, *image)
    weights = image_weights(case, near, error)
    expected = torch.autograd.grad(weighted(image, weights), fields)
    with use(backend) as op:
        image, fields = through(op, torch.float32)
        got = torch.autograd.grad(weighted(image, weights), fields)
    relative = 4 * float(error.max()) + 64 * EPS
    for label, x, y in zip(Projected._fields, got, expected, strict=False):
        assert float((x.cpu().double() - y).norm()) <= relative * float(y.norm()) + 1e-12, label
