"""How exact the Hessian's products are: symmetry, the length of the difference, the rounding of |r|, and float64."""

from __future__ import annotations

from collections.abc import Callable

import torch
from _rows import Row
from torch import Tensor

from splatmill_worker.splat.train.run import TrainingRun

from . import exact
from .curvature import GREY, LIMIT, Objective, product, start
from .lanczos import largest
from .runs import Probe, State

SHARES = [1 / 256, 1 / 64, 1 / 16, 1 / 4, 1.0, 4.0]
"""Lengths of the difference, in steps."""

WIDTHS = [0.0, 0.25, 0.5, 1.0, 2.0, 4.0]
"""Widths of the rounding of |r|, grey levels."""

EXACT = 2
"""Photos of the comparison with float64."""


def measure(state: State) -> list[Row]:
    """Rows of the sweeps at one state."""
    x, metric = state.x, state.metric
    rows: list[Row] = []
    two = Objective(state.mean.shots[:EXACT], degree=state.mean.degree, antialias=state.mean.antialias)
    true = exact.product(two, x, metric)
    sharpest = largest(true, start(metric), tolerance=0.03, most=30)
    gradient = exact.gradient(two, x)
    # Random vectors after one product: mixtures of the directions that are curved.
    mixed = [true(start(metric, seed)) for seed in (1, 2)]
    rows.append(
        {
            "sweep": "float64",
            "largest": sharpest.value / LIMIT,
            "asymmetry": asymmetry(true, *mixed),
            "gradient": float((two.gradient(x) - gradient).norm() / gradient.norm()),
        }
    )
    reached = true(sharpest.vector)
    for share in SHARES:
        fast = product(two.gradient, x, metric, share)
        top = largest(fast, start(metric), tolerance=0.03, most=30)
        rows.append(
            {
                "sweep": "share",
                "value": share,
                "off": float((fast(sharpest.vector) - reached).norm() / reached.norm()),
                "asymmetry": asymmetry(fast, *mixed),
                "largest": top.value / LIMIT,
            }
        )
    for width in WIDTHS:
        every = Objective(
            state.mean.shots, degree=state.mean.degree, antialias=state.mean.antialias, width=width * GREY
        )
        top = largest(product(every.gradient, x, metric), start(metric), tolerance=0.03)
        rows.append({"sweep": "width", "value": width, "largest": top.value / LIMIT})
    return [{"part": "products", **row} for row in rows]


def asymmetry(apply: Callable[[Tensor], Tensor], u: Tensor, v: Tensor) -> float:
    """|u.Av - v.Au| over the mean of |u||Av| and |v||Au|."""
    u, v = u / torch.linalg.vector_norm(u), v / torch.linalg.vector_norm(v)
    of_u, of_v = apply(u), apply(v)
    size = 0.5 * float(of_u.norm() + of_v.norm())
    return abs(float((u * of_v).sum() - (v * of_u).sum())) / size


class Sampled(Probe):
    """Measures the products in place of the eigenvalues."""

    def observe(self, run: TrainingRun) -> None:
        progress, step = run.progress, run.state.step
        self._next += 1
        state = State.of(self.small, run.engine, self.plan, progress, step, 0.5 ** len(self.warnings))
        self.rows += [{**row, "share_of_budget": progress} for row in measure(state)]
