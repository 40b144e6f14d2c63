"""Cloning and splitting by the gradient of the projected mean (Kerbl et al. 2023, section 5.2), up to a number."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.gaussians import Gaussians, concatenate
from splatmill_worker.splat.train.density import prune
from splatmill_worker.splat.train.density.rows import Rows, offsets

THRESHOLD = 2e-4
"""Mean gradient of the projected mean, in NDC units, above which a Gaussian is doubled. The paper's value."""

SPLIT_SHRINK = 1.6
"""Scale of a Gaussian over that of the two it is split into. The paper's value."""

SMALL = 0.01
"""Largest scale over the extent of the scene: up to it Gaussians are cloned, above it split. The paper's value."""


class Change(NamedTuple):
    """How many Gaussians a densification added and removed."""

    added: int
    removed: int


def densify(
    engine: Engine,
    random: torch.Generator,
    *,
    extent: float,
    allowed: int,
    opacity_decay: float = 1.0,
    decay_within: float = math.inf,
) -> Change:
    """Prune, then clone the small and split the large Gaussians whose mean gradient is above THRESHOLD.

    random: places the two halves of a split Gaussian.
    extent: radius of the cameras in the training world.
    allowed: most Gaussians afterwards; those with the largest mean gradient are doubled first.
    opacity_decay: factor on the opacities of the Gaussians that stay as they are.
    decay_within: distance from the origin, in the training world, up to which opacities decay.
    """
    before = engine.count
    score = engine.plain_sum / engine.visible_count.clamp_min(1)
    rows = Rows.of(engine)
    kept = prune.keep(rows.gaussians, engine.max_extent)
    doubled = largest(kept & (score > THRESHOLD), score, allowed - int(kept.sum()))
    large = rows.gaussians.log_scales.amax(dim=1) > math.log(SMALL * extent)
    split, clone = doubled & large, doubled & ~large
    new = concatenate(
        rows.gaussians.select(clone),
        halves(rows.gaussians.select(split), random),
    )
    rows = rows.keep(kept & ~split)
    if opacity_decay < 1.0:
        near = rows.gaussians.means.norm(dim=1) < decay_within
        opacities = rows.gaussians.logit_opacities
        opacities.copy_(torch.where(near, decayed(opacities, opacity_decay), opacities))
    rows = rows.grown(new)
    rows.into(engine)
    added = int(doubled.sum())
    return Change(added=added, removed=before + added - engine.count)


def largest(candidates: Tensor, score: Tensor, limit: int) -> Tensor:
    """The `limit` candidates with the largest scores, bool [N]; ties go to the lower index."""
    if int(candidates.sum()) <= limit:
        return candidates
    picked = torch.zeros_like(candidates)
    if limit > 0:
        rank = torch.where(candidates, score, torch.full_like(score, -1.0))
        picked[torch.argsort(rank, descending=True, stable=True)[:limit]] = True
    return picked


def halves(gaussians: Gaussians, random: torch.Generator) -> Gaussians:
    """Two Gaussians for each: drawn at random from it, smaller by SPLIT_SHRINK; first halves first."""
    twice = gaussians.map(lambda value: torch.cat([value, value]))
    twice.means.add_(offsets(twice, random))
    twice.log_scales.sub_(math.log(SPLIT_SHRINK))
    return twice


def decayed(logit_opacities: Tensor, factor: float) -> Tensor:
    """Logits of opacities multiplied by `factor`."""
    opacity = torch.sigmoid(logit_opacities) * factor
    return torch.logit(opacity.clamp(1e-6, 1 - 1e-6))
