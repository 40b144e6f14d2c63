"""Splitting of Gaussians along their longest axis, up to a number, where the gradient of the projected mean is large.

Deng et al., "Improving Densification in 3D Gaussian Splatting for High-Fidelity Rendering", 2025; Kerbl et al. 2023,
section 5.2, for where.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from splatmill_worker.kernels.reference.project import rotation
from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.train.density import prune
from splatmill_worker.splat.train.density.rows import Rows

THRESHOLD = 2e-4
"""Mean gradient of the projected mean, in NDC units, above which a Gaussian is split. The value of Kerbl et al.
(decisions: densification-score). None are added elsewhere (decisions: error-points)."""

OFFSET = 1.0
"""Distance of each half from the mean of the Gaussian, along its longest axis, over its standard deviation there."""

LONGEST, OTHERS, OPACITY = 0.5, 0.85, 0.6
"""Standard deviations of a half along the longest and the other axes, and its opacity, over those of the Gaussian
(decisions: long-axis-split)."""


class Change(NamedTuple):
    """How many Gaussians a densification added and removed, and how many it did not split because of the limit."""

    added: int
    removed: int
    unsplit: int


def densify(
    engine: Engine,
    *,
    allowed: int,
    opacity_decay: float = 1.0,
    decay_within: float = math.inf,
) -> Change:
    """Prune, then split the Gaussians whose mean gradient is above THRESHOLD.

    allowed: most Gaussians afterwards; those with the largest mean gradient are split first.
    opacity_decay: factor on the opacities of the Gaussians that stay as they are. Their sizes stay (decisions:
        scale-decay).
    decay_within: distance from the origin, in the training world, up to which opacities decay.
    """
    before = engine.count
    score = engine.plain_sum / engine.visible_count.clamp_min(1)
    rows = Rows.of(engine)
    kept = prune.keep(rows.gaussians, engine.max_extent)
    candidates = kept & (score > THRESHOLD)
    split = largest(candidates, score, allowed - int(kept.sum()))
    new = halves(rows.gaussians.select(split))
    rows = rows.keep(kept & ~split)
    if opacity_decay < 1.0:
        near = rows.gaussians.means.norm(dim=1) < decay_within
        opacities = rows.gaussians.logit_opacities
        opacities.copy_(torch.where(near, scaled(opacities, opacity_decay), opacities))
    rows = rows.grown(new)
    rows.into(engine)
    added = int(split.sum())
    return Change(added, before + added - engine.count, int(candidates.sum()) - added)


def largest(candidates: Tensor, score: Tensor, limit: int) -> Tensor:
    """The `limit` candidates with the largest scores, bool [N]; ties go to the lower index."""
    if int(candidates.sum()) <= limit:
        return candidates
    picked = torch.zeros_like(candidates)
    if limit > 0:
        rank = torch.where(candidates, score, torch.full_like(score, -1.0))
        picked[torch.argsort(rank, descending=True, stable=True)[:limit]] = True
    return picked


def halves(gaussians: Gaussians) -> Gaussians:
    """Two Gaussians for each, side by side on its longest axis; first halves first."""
    longest = torch.nn.functional.one_hot(gaussians.log_scales.argmax(dim=1), 3).to(gaussians.means)
    offset = rotation(gaussians.quats) @ (OFFSET * longest * gaussians.log_scales.exp())[:, :, None]
    twice = gaussians.map(lambda value: torch.cat([value, value]))
    twice.means.add_(torch.cat([offset[:, :, 0], -offset[:, :, 0]]))
    shrink = math.log(OTHERS) + longest * math.log(LONGEST / OTHERS)
    twice.log_scales.add_(torch.cat([shrink, shrink]))
    twice.logit_opacities.copy_(scaled(twice.logit_opacities, OPACITY))
    return twice


def scaled(logit_opacities: Tensor, factor: float) -> Tensor:
    """Logits of opacities multiplied by `factor`."""
    opacity = torch.sigmoid(logit_opacities) * factor
    return torch.logit(opacity.clamp(1e-6, 1 - 1e-6))
