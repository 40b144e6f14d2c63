"""Gaussians as samples: dead ones move to where live ones are, and all take part in a random walk
(Kheradmand et al. 2024, 3D Gaussian Splatting as Markov Chain Monte Carlo)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from splatmill_worker.splat.density import prune
from splatmill_worker.splat.density.interface import Change, Moment
from splatmill_worker.splat.density.rows import Rows, rotations
from splatmill_worker.splat.engine import Engine
from splatmill_worker.splat.gaussians import Gaussians

GROWTH = 0.05
"""The number of Gaussians grows by 5 % an event, up to what is allowed."""

NOISE = 5e5
"""Weight of the random walk over the position rate (the paper's)."""

NOISE_EVERY = 25
"""Steps between two moves of the walk, with the variance of that many: a move touches every Gaussian."""


@dataclass
class Mcmc:
    """Relocation, growth and noise; nothing is ever split by gradient."""

    min_opacity: float = prune.MIN_OPACITY
    steps_since_noise: int = 0

    @property
    def scores(self) -> None:
        """None: opacities decide."""
        return None

    def densify(self, engine: Engine, moment: Moment, random: torch.Generator) -> Change:
        rows = Rows.of(engine)
        alive = prune.keep(rows.gaussians, None, min_opacity=self.min_opacity)
        if not bool(alive.any()):
            rows.keep(alive).into(engine)
            return Change(removed=int((~alive).sum()))
        dead = int((~alive).sum())
        rows = rows.keep(alive)
        room = moment.allowed - rows.gaussians.count
        wanted = dead + math.ceil(GROWTH * (rows.gaussians.count + dead))
        added = max(0, min(wanted, room))
        if added:
            chance = torch.sigmoid(rows.gaussians.logit_opacities)
            source = torch.multinomial(chance.cpu(), added, replacement=True, generator=random).to(
                chance.device
            )
            copies = torch.bincount(source, minlength=rows.gaussians.count) + 1
            shared(rows.gaussians, copies)
            changed = copies > 1
            rows.exp_avg[changed] = 0.0
            rows.exp_avg_sq[changed] = 0.0
            rows = rows.grown(rows.gaussians.select(source))
        rows.into(engine)
        return Change(added=added, removed=dead)

    def after_step(self, engine: Engine, position_rate: float, random: torch.Generator) -> None:
        self.steps_since_noise += 1
        if self.steps_since_noise < NOISE_EVERY:
            return
        parameters = engine.parameters()
        exp_avg, exp_avg_sq = engine.moments()
        size = NOISE * position_rate * math.sqrt(self.steps_since_noise)
        parameters["means"] += size * walk(Gaussians(**parameters), random)
        engine.replace(parameters, exp_avg, exp_avg_sq)
        self.steps_since_noise = 0


def walk(gaussians: Gaussians, random: torch.Generator) -> Tensor:
    """One move [N, 3]: within the Gaussian's own covariance, and only for those that are nearly transparent."""
    opacity = torch.sigmoid(gaussians.logit_opacities)
    free = torch.sigmoid(-100.0 * (opacity - prune.MIN_OPACITY))
    noise = torch.randn(gaussians.count, 3, generator=random).to(gaussians.means)
    turn = rotations(gaussians.quats)
    variances = (2.0 * gaussians.log_scales).exp()
    local = variances * torch.einsum("nij,ni->nj", turn, noise)
    return torch.einsum("nij,nj->ni", turn, local) * free[:, None]


def shared(gaussians: Gaussians, copies: Tensor) -> None:
    """In place: opacity and scale of each Gaussian so that `copies` [N] of it on one spot look like it did.

    Equation 9 of the paper: o' = 1 - (1 - o)^(1/n), and the scales shrink by o over a sum that keeps the
    integral along a ray.
    """
    many = copies > 1
    n = copies[many].clamp_max(51)
    opacity = torch.sigmoid(gaussians.logit_opacities[many]).double()
    part = 1.0 - (1.0 - opacity).pow(1.0 / n)
    total = torch.zeros_like(part)
    for i in range(1, int(n.max()) + 1 if n.numel() else 1):
        for k in range(i):
            term = math.comb(i - 1, k) * (-1.0) ** k / math.sqrt(k + 1) * part.pow(k + 1)
            total += torch.where(n >= i, term, torch.zeros_like(term))
    gaussians.logit_opacities[many] = torch.logit(part.clamp(0.005, 1 - 1e-6)).float()
    gaussians.log_scales[many] += (opacity / total).log().float()[:, None]
