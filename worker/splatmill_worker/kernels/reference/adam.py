"""Adam over all parameter groups of a scene, dense or for the visible Gaussians only."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ..records import BETA1, BETA2, EPS

MEMORY = 256
"""Missed steps whose drift is computed: the terms of later ones are below (0.9 / sqrt beta2)^256, which is 2e-12 for
0.999 and 3e-11 for 0.98."""


@torch.no_grad()
def adam_(
    params: Sequence[Tensor],
    grads: Sequence[Tensor],
    exp_avg: Sequence[Tensor],
    exp_avg_sq: Sequence[Tensor],
    rates: Sequence[float],
    *,
    step: int,
    visible: Tensor | None = None,
    last_step: Tensor | None = None,
    beta2: float = BETA2,
) -> int:
    """Take one Adam step in place (Kingma & Ba 2015; BETA1, beta2 and EPS) on groups [N, ...] with a rate each.

    step counts from 1; the bias is corrected by it for all rows, whenever they came (decisions: bias-correction). With
    visible [N] (bool) only those rows move; last_step int32 [N] is the step up to which each row is current, and a row
    that missed steps is first brought, by `catch_up_`, to where dense Adam with zero gradients would have left it
    (decisions: moments-out-of-view). beta2 is the same in every step, LEAST_BETA2 or more and below 1. An entry whose
    gradient, or the gradient's square, is not finite stays as it is. Returns the number of such entries. Raises
    ValueError for visible without last_step.

    float32 state does not underflow: eps outweighs the root of the second moment v where v < 1e-30, while float32 holds
    v down to 1e-38. A gradient whose square is 0 in float32 moves its parameter by less than rate * 1e-3.
    """
    if visible is not None:
        if last_step is None:
            raise ValueError("last_step: needed with visible, to know how many steps a row missed")
        catch_up_(
            params, exp_avg, exp_avg_sq, rates, step=step - 1, rows=visible, last_step=last_step, beta2=beta2
        )
        last_step[visible] = step
    size, root = 1 / (1 - BETA1**step), 1 / math.sqrt(1 - beta2**step)
    refused = 0
    for p, g, m, v, rate in zip(params, grads, exp_avg, exp_avg_sq, rates, strict=True):
        good = torch.isfinite(g * g)
        if visible is not None:
            rows = visible.reshape(-1, *[1] * (g.dim() - 1))
            refused += int((rows & ~good).sum())
            good = good & rows
        else:
            refused += int((~good).sum())
        g = torch.where(good, g, 0.0)
        m_new, v_new = BETA1 * m + (1 - BETA1) * g, beta2 * v + (1 - beta2) * g * g
        moved = p - rate * size * m_new / (root * v_new.sqrt() + EPS)
        for old, new in ((m, m_new), (v, v_new), (p, moved)):
            old.copy_(torch.where(good, new, old))
    return refused


@torch.no_grad()
def catch_up_(
    params: Sequence[Tensor],
    exp_avg: Sequence[Tensor],
    exp_avg_sq: Sequence[Tensor],
    rates: Sequence[float],
    *,
    step: int,
    rows: Tensor,
    last_step: Tensor,
    beta2: float = BETA2,
) -> None:
    """Bring rows [N] (bool) from their last_step to step, as dense Adam with zero gradients would have done.

    Moments decay by powers of the betas. The parameter drifts by rate * m / sqrt(v) times a sum that depends on the two
    step numbers alone (`drift`). eps is left out, which changes nothing while sqrt(v) >> 1e-15.
    """
    missed = torch.where(rows, step - last_step, 0).clamp_min(0)
    table = {int(k): drift(step - int(k), step, beta2) for k in torch.unique(missed)}
    travel = torch.tensor([table[int(k)] for k in missed.tolist()], dtype=torch.float64)
    for p, m, v, rate in zip(params, exp_avg, exp_avg_sq, rates, strict=True):
        shape = (-1, *[1] * (p.dim() - 1))
        ratio = torch.where(v > 0, m / v.sqrt(), 0.0)
        p -= (rate * travel.to(p)).reshape(shape) * ratio
        m *= (BETA1 ** missed.to(p.dtype)).reshape(shape)
        v *= (beta2 ** missed.to(p.dtype)).reshape(shape)
    last_step[rows] = step


def drift(last: int, step: int, beta2: float = BETA2) -> float:
    """Return the sum over steps s = last + j <= step of beta1^j / (1 - beta1^s) * sqrt((1 - beta2^s) / beta2^j)."""
    total = 0.0
    for j in range(1, min(step - last, MEMORY) + 1):
        s = last + j
        total += BETA1**j / (1 - BETA1**s) * math.sqrt((1 - beta2**s) / beta2**j)
    return total
