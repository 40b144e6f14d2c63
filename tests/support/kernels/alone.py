"""project, composite and loss each by itself: its gradients by any backend, and the units of those.

The unit of a value is the root mean square of its change, in float64, by the roundings that the op must or may make:
of its inputs and, as they apply, of 2^x, of what lies behind a splat and of the loss's windows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import torch
from _studies.stability.roundings import (
    TINY,
    U,
    inexact_exponential,
    rounded_remainders,
    rounded_up_or_down,
    rounded_windows,
)
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.records import Bins, Projected
from tests.support.kernels.cases import GROUPS, Case
from tests.support.kernels.proof import filled, weighted, where
from tests.support.kernels.units import DRAWS, moved_leaf

Outputs = dict[str, Tensor]
Change = Callable[[Tensor], Tensor]


def spread(exact: Outputs, *kinds: Iterable[Outputs]) -> Outputs:
    """The root mean square change over each kind of samples, added as squares, and half an ulp of the value."""
    total = {k: torch.zeros_like(x) for k, x in exact.items()}
    for samples in kinds:
        outputs = list(samples)
        for sample in outputs:
            for k, x in sample.items():
                total[k] += (x - exact[k]) ** 2 / len(outputs)
    return {k: total[k].sqrt() + U * x.abs() + TINY for k, x in exact.items()}


def rounding(seed: int = 17) -> tuple[torch.Generator, Change]:
    g = torch.Generator().manual_seed(seed)
    return g, lambda x: rounded_up_or_down(x, g)


# ---- project


def field_weights(p: Projected) -> list[Tensor]:
    """Random weights on project's differentiable fields: means2d, conics, opacities, colours, depths."""
    g = torch.Generator().manual_seed(6)
    return [torch.randn(field.shape, generator=g) for field in p[:5]]


def project_gradients(
    case: Case,
    weights: Sequence[Tensor],
    op: ops.Backend,
    dtype: torch.dtype,
    change: Change = lambda x: x,
) -> Outputs:
    """Gradients of the weighted fields to the five groups and the viewmat, with every input changed."""
    device = where(op)
    named = zip((*GROUPS, "viewmat"), (*case.groups(dtype), case.viewmat.to(dtype)), strict=True)
    leaves = {k: moved_leaf(k, x, change).to(device).requires_grad_() for k, x in named}
    p = replace(case, K=change(case.K.to(dtype))).project([leaves[k] for k in GROUPS], leaves["viewmat"], op)
    total = weighted(p[:5], [change(w.to(dtype)) for w in weights])
    return dict(zip(leaves, torch.autograd.grad(total, list(leaves.values())), strict=True))


def project_units(case: Case, weights: Sequence[Tensor], exact: Outputs) -> Outputs:
    _, moved = rounding()
    return spread(
        exact,
        (project_gradients(case, weights, "reference", torch.float64, moved) for _ in range(DRAWS)),
    )


# ---- composite


def composite_gradients(
    case: Case,
    rounded: Projected,
    bins: Bins | None,
    weights: Sequence[Tensor],
    op: ops.Backend,
    dtype: torch.dtype,
    change: Change = lambda x: x,
) -> Outputs:
    """Gradients of the weighted images to the fields of `rounded`; its own lists where none are given."""
    device = where(op)
    fields = [change(x.to(dtype)).to(device).requires_grad_() for x in rounded[:5]]
    p = filled(rounded, fields)
    lists = ops.bin(p, case.width, case.height, backend=op) if bins is None else bins
    image = ops.composite(p, lists, case.width, case.height, backend=op)
    total = weighted(image, [change(w.to(dtype)) for w in weights])
    return dict(zip(Projected._fields, torch.autograd.grad(total, fields), strict=False))


def composite_units(
    case: Case, rounded: Projected, bins: Bins, weights: Sequence[Tensor], exact: Outputs
) -> Outputs:
    g, moved = rounding()

    def exponential(sign: float) -> Outputs:
        with inexact_exponential(g, sign):
            return composite_gradients(case, rounded, bins, weights, "reference", torch.float64)

    def remainder() -> Outputs:
        d_color, d_alpha, d_depth = (w.double() for w in weights)
        fields = [x.double().requires_grad_() for x in rounded[:5]]
        with rounded_remainders(torch.cat([d_color, d_depth[..., None]], 2), g, -d_alpha) as terms:
            image = ops.composite(filled(rounded, fields), bins, case.width, case.height, backend="reference")
        total = torch.stack(terms).sum() + 0 * weighted(image, weights)
        off = dict(zip(Projected._fields, torch.autograd.grad(total, fields), strict=False))
        return {k: exact[k] + x for k, x in off.items()}

    return spread(
        exact,
        (
            composite_gradients(case, rounded, bins, weights, "reference", torch.float64, moved)
            for _ in range(DRAWS)
        ),
        (exponential(sign) for sign in (1.0, 0.0, 0.0)),
        (remainder() for _ in range(DRAWS)),
    )


# ---- loss


def loss_units(color: Tensor, photo: Tensor, mask: Tensor | None, exact: Outputs) -> Outputs:
    """Units of the value and of its gradient: by rounding the image and every windowed moment."""
    g, moved = rounding()

    def rounded(common: bool) -> Outputs:
        leaf = moved(color.double()).requires_grad_()
        with rounded_windows(g, common):
            value = ops.loss(leaf, photo, mask=mask, backend="reference")
        (gradient,) = torch.autograd.grad(value, leaf)
        return {"value": value.detach(), "gradient": gradient}

    return spread(exact, (rounded(False) for _ in range(DRAWS)), (rounded(True) for _ in range(DRAWS)))
