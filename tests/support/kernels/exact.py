"""The definition of every case with its gradients and the units of both, computed once in a process."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from tests.support.kernels.cases import CASES, Case
from tests.support.kernels.proof import Run, alpha_error, define, margins, weighted
from tests.support.kernels.units import Units, units


@dataclass(frozen=True)
class Exact:
    case: Case
    want: Run
    weights: tuple[Tensor, Tensor, Tensor]  # of the three images, zero where a decision could go either way
    gradients: dict[str, Tensor]  # of the weighted sum
    units: Units
    undecided: Tensor  # [H,W] pixels where float32 may take another decision
    rho: float  # the largest relative error of an alpha (`alpha_error`)


@cache
def exact(name: str) -> Exact:
    """The definition of the case of that name."""
    return exact_of(CASES[name]())


def exact_of(case: Case) -> Exact:
    """The definition of any case."""
    want = define(case)
    error = alpha_error(case, want.projected)
    weights = image_weights(case, want, error)
    near = margins(want.projected, want.bins, case.width, case.height, error).jump <= 1
    rho = float(error.max()) if len(error) else 0.0
    d_opacities = torch.autograd.grad(
        weighted((want.color, want.alpha, want.depth), weights),
        want.projected.opacities,
        retain_graph=True,
        allow_unused=True,
    )[0]
    gradients = want.gradients(*weights)
    if d_opacities is not None:
        # The same derivative as autograd's o (1 - o), which is 0 in float64 from a logit of 37 on.
        against = torch.sigmoid(-case.logit_opacities.double())
        gradients["logit_opacities"] = d_opacities * want.projected.opacities.detach() * against
    return Exact(case, want, weights, gradients, units(case, want, weights), near, rho)


def image_weights(case: Case, want: Run, error: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Random weights, zero where a decision could go either way."""
    near = margins(want.projected, want.bins, case.width, case.height, error)
    sure = (near.jump > 1) & (near.gate > 1)
    g = torch.Generator().manual_seed(5)
    shape = (case.height, case.width)
    d_color = torch.randn(*shape, 3, generator=g) * sure[..., None]
    return d_color, torch.randn(shape, generator=g) * sure, torch.randn(shape, generator=g) * sure
