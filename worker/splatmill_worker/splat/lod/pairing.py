"""Which Gaussians are merged: neighbours whose union differs least from them, each in at most one pair.

Source: Runnalls, "Kullback-Leibler Approach to Gaussian Mixture Reduction" (2007), whose bound is the cost of a pair; a
squared difference of colour is added to it.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from splatmill_worker.kernels.morton import morton_order
from splatmill_worker.splat.gaussians import SH_C0
from splatmill_worker.splat.lod.moments import Moments, union

NEIGHBOURS = 6
"""Places along the space-filling curve within which the partners of a Gaussian are looked for (decisions: lod)."""

PASSES = 2
"""Times that pairs are looked for with the same costs, the second among the rows left (decisions: lod)."""

COLOR_STEP = 0.1
"""Difference of colour, of 1, that costs as much as a distance of one standard deviation."""

SOFTENING = 0.1
"""Standard deviation that is added to every Gaussian, over the root of the largest variance of the pair: two halves of
one surface cost little although they are thin."""

_SHIFTS = (0.0, 0.37, 0.71, 0.13, 0.59)
"""Shifts of the space-filling curve, over the width of the group, from round to round: no border is one in all."""


def pairs(moments: Moments, groups: Tensor, most: int, turn: int) -> tuple[Tensor, Tensor]:
    """Rows to merge, int64 [M] each: at most `most` pairs, those that cost least, of rows of the same group.

    groups: int64 [N], ascending. turn: which of the shifts of the curve is used.

    A pair is one of rows that each prefer the other over all neighbours, or over those that are not yet in a pair.
    """
    order = _order(moments.shapes.means, groups, _SHIFTS[turn % len(_SHIFTS)])
    costs = [*_costs(moments, groups, order)]
    free = torch.ones(moments.count, dtype=torch.bool)
    batches = []
    for _ in range(PASSES):
        best, partner = _preferred(costs, free)
        first = (partner >= 0).nonzero()[:, 0]
        first = first[(partner[partner[first]] == first) & (first < partner[first])]
        batches.append((best[first], first, partner[first]))
        free[first] = free[partner[first]] = False
    cost, first, second = (torch.cat(parts) for parts in zip(*batches, strict=True))
    if len(cost) > most:
        cheapest = torch.argsort(cost, stable=True)[:most]
        first, second = first[cheapest], second[cheapest]
    return order[first], order[second]


def _preferred(costs: list[Tensor], free: Tensor) -> tuple[Tensor, Tensor]:
    """The least cost of each place and its partner, -1 where it has none, among the places that are `free`."""
    best = torch.full((len(free),), torch.inf, dtype=torch.float64)
    partner = torch.full((len(free),), -1)
    places = torch.arange(len(free))
    for step, cost in enumerate(costs, 1):
        cost = torch.where(free[:-step] & free[step:], cost, torch.inf)
        for side, other in ((slice(None, -step), places[step:]), (slice(step, None), places[:-step])):
            better = cost < best[side]
            best[side] = torch.where(better, cost, best[side])
            partner[side] = torch.where(better, other, partner[side])
    return best, partner


def _order(means: Tensor, groups: Tensor, shift: float) -> Tensor:
    """Rows by group, and within each along the curve through the bounds of all, moved by a share of their width."""
    low, high = torch.aminmax(means, dim=0)
    corners = torch.stack([low - shift * (high - low), high + (1 - shift) * (high - low)])
    order = morton_order(torch.cat([means, corners]), cubic=True)
    order = order[order < len(means)]
    return order[torch.argsort(groups[order], stable=True)]


def _costs(moments: Moments, groups: Tensor, order: Tensor) -> Iterator[Tensor]:
    """Yield the costs [N - step] of the pairs of places (i, i + step) of the order, step by step; inf across groups."""
    shapes = moments.shapes[order]
    colors = moments.sh[order, :3].double() * (SH_C0 / COLOR_STEP)
    alone = shapes.masses * _determinants(shapes.covariances)
    groups = groups[order]
    for step in range(1, min(NEIGHBOURS, len(order) - 1) + 1):
        first, second = shapes[:-step], shapes[step:]
        masses, covariances = union(first, second)
        cost = masses * _determinants(covariances) - alone[:-step] - alone[step:]
        color = (colors[:-step] - colors[step:]).square().sum(1)
        cost += first.masses * second.masses / masses.clamp(min=1e-300) * color
        yield torch.where(groups[:-step] == groups[step:], cost, torch.inf)


def _determinants(covariances: Tensor) -> Tensor:
    """Logarithms of the determinants [N] of the softened covariances."""
    xx, xy, xz, yy, yz, zz = covariances.unbind(1)
    more = SOFTENING**2 * (xx + yy + zz)
    xx, yy, zz = xx + more, yy + more, zz + more
    minors = (yy * zz - yz * yz), (xy * zz - xz * yz), (xy * yz - xz * yy)
    return (xx * minors[0] - xy * minors[1] + xz * minors[2]).clamp(min=1e-300).log()
