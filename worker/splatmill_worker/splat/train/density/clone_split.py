"""Clone and split by the gradient of the projected mean (Kerbl et al. 2023, section 5.2), within a budget."""

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
"""The paper's least mean score worth another Gaussian, in NDC units."""

SPLIT_SHRINK = 1.6
"""The paper's factor between the scale of a Gaussian and those of its two halves."""

SMALL = 0.01
"""Share of the scene extent: smaller Gaussians are cloned, larger ones split."""


class Change(NamedTuple):
    """How many Gaussians an event added and removed."""

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
    """The Gaussians with the largest mean gradient are doubled: the small are cloned, the large are split.

    extent: radius of the cameras in the training world. Of those above THRESHOLD, no more are taken than `allowed`
    Gaussians leave room for, the largest scores first. opacity_decay: factor on the opacities of those that stay
    and are nearer to the origin than `decay_within`.
    """
    before = engine.count
    score = engine.plain_sum / engine.visible_count.clamp_min(1)
    rows = Rows.of(engine)
    stay = prune.keep(rows.gaussians, engine.max_extent)
    hot = stay & (score > THRESHOLD)
    hot = strongest(hot, score, allowed - int(stay.sum()))
    large = rows.gaussians.log_scales.amax(dim=1) > math.log(SMALL * extent)
    split, clone = hot & large, hot & ~large
    new = concatenate(
        rows.gaussians.select(clone),
        halves(rows.gaussians.select(split), random),
    )
    rows = rows.keep(stay & ~split)
    if opacity_decay < 1.0:
        near = rows.gaussians.means.norm(dim=1) < decay_within
        opacities = rows.gaussians.logit_opacities
        opacities.copy_(torch.where(near, decayed(opacities, opacity_decay), opacities))
    rows = rows.grown(new)
    rows.into(engine)
    added = int(hot.sum())
    return Change(added=added, removed=before + added - engine.count)


def strongest(candidates: Tensor, score: Tensor, room: int) -> Tensor:
    """bool [N]: at most `room` of the candidates, the largest scores first (ties by index)."""
    if int(candidates.sum()) <= room:
        return candidates
    picked = torch.zeros_like(candidates)
    if room > 0:
        rank = torch.where(candidates, score, torch.full_like(score, -1.0))
        picked[torch.argsort(rank, descending=True, stable=True)[:room]] = True
    return picked


def halves(gaussians: Gaussians, random: torch.Generator) -> Gaussians:
    """Two Gaussians for each: placed at random inside it, smaller by SPLIT_SHRINK."""
    twice = gaussians.map(lambda value: torch.cat([value, value]))
    twice.means.add_(offsets(twice, random))
    twice.log_scales.sub_(math.log(SPLIT_SHRINK))
    return twice


def decayed(logit_opacities: Tensor, factor: float) -> Tensor:
    """Logits of opacities multiplied by `factor`."""
    opacity = torch.sigmoid(logit_opacities) * factor
    return torch.logit(opacity.clamp(1e-6, 1 - 1e-6))
