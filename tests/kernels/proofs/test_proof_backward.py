"""Every backend differentiates every case as the definition does: the chain of ops, and project and composite alone.

The definition is the float64 reference; that its gradient is right is shown by test_reference_order. Every Gaussian's
gradient is compared in units of what rounding does to it (`units`); a norm over all would hide one. Pixels within
the error of float32 of a threshold get no weight here, since the gradient jumps there; test_proof_forward shows that
they are few.
"""

from __future__ import annotations

from functools import cache

import pytest
import torch
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.records import Projected
from tests.support.kernels.alone import (
    Outputs,
    composite_gradients,
    composite_units,
    field_weights,
    project_gradients,
    project_units,
)
from tests.support.kernels.bounds import LIMIT, ON_A_CARD, SUM_LIMIT, within
from tests.support.kernels.cases import CASES, GROUPS, Case
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
    where,
)


@pytest.mark.parametrize("backend", backends())
@pytest.mark.parametrize("name", CASES)
def test_gradient_is_the_definitions(name: str, backend: str) -> None:
    known = exact(name)
    case, want = known.case, known.want
    with use(backend) as op:
        got = run(case, op).gradients(*known.weights)
    limit = LIMIT * ON_A_CARD.get(name, 1.0) if where(backend) == "cuda" else LIMIT
    for k, b in known.gradients.items():
        a, unit = got[k].cpu().double(), known.units.separate[k]
        assert torch.isfinite(a).all(), k
        # The gradients to the camera and the background are one vector each; all others have a row for every Gaussian.
        alone = k not in GROUPS
        error, u = ((a - b)[None], unit[None]) if alone else (a - b, unit)
        within(f"gradient to {k}", name, error, u, limit)
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
    case, weights, expected, unit = alone_project(name)
    with use(backend) as op:
        got = project_gradients(case, weights, op, torch.float32)
    for k, b in expected.items():
        error, u = got[k].cpu().double() - b, unit[k]
        alone = k == "viewmat"
        within(
            f"project alone, gradient to {k}", f"{name}, project alone",
            error[None] if alone else error, u[None] if alone else u, SUM_LIMIT if alone else LIMIT,
        )  # fmt: skip


@cache
def alone_project(name: str) -> tuple[Case, list[Tensor], Outputs, Outputs]:
    """The case, the weights of project's fields, its exact gradients and their units, once for all backends."""
    case = CASES[name]()
    weights = field_weights(define(case).projected)
    expected = project_gradients(case, weights, "reference", torch.float64)
    return case, weights, expected, project_units(case, weights, expected)


@pytest.mark.parametrize("backend", backends())
@pytest.mark.parametrize(
    "name", ["ordinary", "degree 1", "needles 1e+02", "sub-pixel", "pile of opaque", "dark", "portrait"]
)
def test_composite_alone(name: str, backend: str) -> None:
    """The same rounded splats given to both: gradients to every field of them."""
    case, rounded, weights, expected, unit = alone_composite(name)
    with use(backend) as op:
        got = composite_gradients(case, rounded, None, weights, op, torch.float32)
    for k, b in expected.items():
        within(f"composite alone, gradient to {k}", name, got[k].cpu().double() - b, unit[k])


@cache
def alone_composite(name: str) -> tuple[Case, Projected, tuple[Tensor, ...], Outputs, Outputs]:
    """The case, its rounded splats, the images' weights, and the exact gradients and their units."""
    case = CASES[name]()
    want = define(case)
    rounded = Projected(*(x.detach().float() for x in want.projected))
    # A conic's smaller eigenvalue, recovered from three float32 numbers, is known to condition * 4 eps.
    error = alpha_error(case, want.projected) + 5.5 * 4 * EPS * condition(rounded.conics)
    fields = filled(rounded, [x.double() for x in rounded[:5]])
    image = ops.composite(fields, want.bins, case.width, case.height, backend="reference")
    weights = image_weights(case, Run({}, fields, want.bins, *image), error)
    expected = composite_gradients(case, rounded, want.bins, weights, "reference", torch.float64)
    return case, rounded, weights, expected, composite_units(case, rounded, want.bins, weights, expected)


def condition(conics: Tensor) -> Tensor:
    """Ratio of the larger to the smaller eigenvalue of each conic."""
    a, b, c = conics.double().unbind(1)
    root = torch.sqrt(((a - c) / 2) ** 2 + b * b)
    low = (a + c) / 2 - root
    return torch.where(low > 0, ((a + c) / 2 + root) / low.clamp_min(1e-30), 1.0)
