"""How far an engine may be from the definition, value by value: the effect of the roundings that it must or may make.

The unit of an output is the root mean square of its change, in float64, by rounding the inputs, by the error of 2^x, by
the rounding of what lies behind a splat (`_studies.stability.roundings`), and, for the separate ops, by rounding what
they pass to one another: a needle is known no better from three rounded numbers of a conic. Each of the four is
measured alone, over a few draws.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import torch
from _studies.functions.tolerances import U
from _studies.stability.roundings import TINY, inexact_exponential, rounded_remainders, rounded_up_or_down
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.records import Bins
from tests.support.kernels.cases import GROUPS, Case
from tests.support.kernels.proof import Run, filled, weighted

DRAWS = 4
NAMES = (*GROUPS, "viewmat", "background")
IMAGES = ("color", "alpha", "depth")

Weights = Sequence[Tensor]
Outputs = dict[str, Tensor]
Change = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Units:
    """By output (the three images and the gradient to each leaf), the change by one rounding of everything.

    fused: where projected Gaussians are not rounded to conics.
    separate: where they are.
    """

    fused: Outputs
    separate: Outputs


def units(case: Case, want: Run, weights: Weights) -> Units:
    """The units of a case's images, and of the gradients of their sum weighted by `weights`."""
    g = torch.Generator().manual_seed(17)
    leaves = [x.detach().double() for x in want.leaves.values()]
    intrinsics, d_images = case.K.double(), [w.double() for w in weights]

    def moved(x: Tensor) -> Tensor:
        return rounded_up_or_down(x, g)

    exact = _outputs(case, leaves, intrinsics, want.bins, d_images)

    def squares(samples: Iterable[Outputs]) -> Outputs:
        total = {k: torch.zeros_like(x) for k, x in exact.items()}
        count = 0
        for sample in samples:
            count += 1
            for k, x in sample.items():
                total[k] += (x - exact[k]) ** 2
        return {k: x / max(count, 1) for k, x in total.items()}

    def inputs() -> Outputs:
        changed = [moved_leaf(k, x, moved) for k, x in zip(NAMES, leaves, strict=True)]
        return _outputs(case, changed, moved(intrinsics), want.bins, [moved(w) for w in d_images])

    def exponential(sign: float) -> Outputs:
        with inexact_exponential(g, sign):
            return _outputs(case, leaves, intrinsics, want.bins, d_images)

    def remainder() -> Outputs:
        d_color, d_alpha, d_depth = d_images
        beyond = d_color @ case.background.double() - d_alpha
        with rounded_remainders(torch.cat([d_color, d_depth[..., None]], 2), g, beyond) as terms:
            alive, images = _drawn(case, leaves, intrinsics, want.bins, None)
        if not terms:
            return exact
        total = torch.stack(terms).sum() + 0 * weighted(images, d_images)
        return {k: exact[k] + x for k, x in _gradients(total, alive).items()}

    def passed_on() -> Outputs:
        return _outputs(case, leaves, intrinsics, want.bins, d_images, moved)

    parts = [
        squares(inputs() for _ in range(DRAWS)),
        # The sign is common where many alphas are nearly equal, as in a pile; then errors add up.
        squares(exponential(sign) for sign in (1.0, 0.0, 0.0)),
        squares(remainder() for _ in range(DRAWS)),
    ]
    between = squares(passed_on() for _ in range(DRAWS))

    def rooted(variances: list[Outputs]) -> Outputs:
        return {
            k: torch.stack([p[k] for p in variances]).sum(0).sqrt() + U * x.abs() + TINY
            for k, x in exact.items()
        }

    return Units(rooted(parts), rooted([*parts, between]))


def moved_leaf(name: str, x: Tensor, moved: Change) -> Tensor:
    """x with a relative change, which for the argument of an exponential is at least that of its result."""
    # exp rounds its result, which is as if its argument had moved by the roundoff itself.
    smallest = 1.0 if name in ("log_scales", "logit_opacities") else 0.0
    return x + (moved(torch.ones_like(x)) - 1) * x.abs().clamp_min(smallest)


def _drawn(
    case: Case, leaves: Sequence[Tensor], intrinsics: Tensor, bins: Bins, change: Change | None
) -> tuple[dict[str, Tensor], tuple[Tensor, Tensor, Tensor]]:
    alive = {k: x.detach().clone().requires_grad_() for k, x in zip(NAMES, leaves, strict=True)}
    p = replace(case, K=intrinsics).project([alive[k] for k in GROUPS], alive["viewmat"], "reference")
    if change is not None:
        p = filled(p, [x * change(torch.ones_like(x)) for x in p[:5]])
    images = ops.composite(
        p, bins, case.width, case.height, background=alive["background"], backend="reference"
    )
    return alive, images


def _gradients(total: Tensor, alive: dict[str, Tensor]) -> Outputs:
    gradients = torch.autograd.grad(total, list(alive.values()), allow_unused=True)
    pairs = zip(alive.items(), gradients, strict=True)
    return {k: torch.zeros_like(x) if grad is None else grad for (k, x), grad in pairs}


def _outputs(
    case: Case,
    leaves: Sequence[Tensor],
    intrinsics: Tensor,
    bins: Bins,
    d_images: Weights,
    change: Change | None = None,
) -> Outputs:
    alive, images = _drawn(case, leaves, intrinsics, bins, change)
    gradients = _gradients(weighted(images, d_images), alive)
    return {**{k: x.detach() for k, x in zip(IMAGES, images, strict=True)}, **gradients}
