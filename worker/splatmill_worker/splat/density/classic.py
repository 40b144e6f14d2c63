"""Clone and split by the gradient of the projected mean (Kerbl et al. 2023, section 5.2), within a budget."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from splatmill_worker.kernels.records import Scores
from splatmill_worker.splat.density import prune
from splatmill_worker.splat.density.event import Change, Moment
from splatmill_worker.splat.density.rows import Rows, offsets
from splatmill_worker.splat.engine import Engine
from splatmill_worker.splat.gaussians import Gaussians, concatenate

SPLIT_SHRINK = 1.6
"""The paper's factor between the scale of a Gaussian and those of its two halves."""

SMALL = 0.01
"""Share of the scene extent: smaller Gaussians are cloned, larger ones split."""


@dataclass
class Classic:
    """The Gaussians with the largest mean gradient are doubled: the small are cloned, the large are split.

    score "plain" is the paper's; "absolute" adds the magnitudes over pixels (Ye et al. 2024, AbsGS), so that
    pulls in opposite directions do not cancel. `threshold` is the least mean score worth a Gaussian, in NDC
    units. Of those above it, no more are taken than `Moment.allowed` leaves room for, the largest scores first.
    """

    score: Scores
    threshold: float
    opacity_decay: float = 1.0

    @property
    def scores(self) -> Scores:
        """The score decides, and visibility and extent come with either."""
        return self.score

    def densify(self, engine: Engine, moment: Moment, random: torch.Generator) -> Change:
        before = engine.count
        score = self._score(engine)
        rows = Rows.of(engine)
        stay = prune.keep(rows.gaussians, engine.max_extent)
        hot = stay & (score > self.threshold)
        hot = strongest(hot, score, moment.allowed - int(stay.sum()))
        large = rows.gaussians.log_scales.amax(dim=1) > math.log(SMALL * moment.extent)
        split, clone = hot & large, hot & ~large
        new = concatenate(
            rows.gaussians.select(clone),
            halves(rows.gaussians.select(split), random),
        )
        rows = rows.keep(stay & ~split)
        if self.opacity_decay < 1.0:
            rows.gaussians.logit_opacities.copy_(decayed(rows.gaussians.logit_opacities, self.opacity_decay))
        rows = rows.grown(new)
        rows.into(engine)
        added = int(hot.sum())
        return Change(added=added, removed=before + added - engine.count)

    def _score(self, engine: Engine) -> Tensor:
        total = engine.plain_sum if self.score == "plain" else engine.abs_sum
        if total is None:
            raise ValueError("This backend has no absolute gradients; choose densify=classic.")
        return total / engine.visible_count.clamp_min(1)


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
