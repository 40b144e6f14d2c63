"""Makes the levels of detail of a model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from splatmill_worker.kernels.morton import morton_order
from splatmill_worker.splat.gaussians import Gaussians, concatenate
from splatmill_worker.splat.lod.moments import Moments, gaussians_of, merged, moments_of
from splatmill_worker.splat.lod.pairing import pairs
from splatmill_worker.splat.lod.partition import LEAF, Node, partition
from splatmill_worker.splat.orbit import MIDDLE

RATIO = 4
"""Gaussians of a level over those of the next. Gaussians lie on surfaces, so a quarter of them have twice the size, as
pixels have at twice the distance; all levels together have a third more Gaussians than the model."""

COARSEST = 32768
"""Gaussians of the coarsest level at most: with 20 bytes each, 0.7 MB have to be there for the first picture."""

MOST_SURROUNDINGS = 32768
"""Gaussians of the surroundings at most, which have no levels and are loaded for the first picture too. Where more are
far away, they are part of the scene."""

_BATCH = 2**18
"""Gaussians that are merged at a time, which takes about 0.6 GB."""

_MOST_ROUNDS = 24
"""Rounds of pairs in which a level is reached at most; four to six are usual."""


@dataclass(frozen=True)
class Run:
    """The Gaussians of a leaf in a level: the rows from `first` to before `first + count`."""

    first: int
    count: int


@dataclass(frozen=True)
class Level:
    """A level of detail.

    gaussians: float32, those of each leaf together, in Morton order.
    runs: one for each leaf of the tree.
    errors: one for each leaf, world units: how far from its place what is seen at level 0 is drawn, root mean square
        over it, by opacity times area. 0 at level 0, and never less than at the level before.
    """

    gaussians: Gaussians
    runs: tuple[Run, ...]
    errors: tuple[float, ...]


@dataclass(frozen=True)
class Levels:
    """A model in levels of detail.

    tree: of the scene, whose leaves have a run in every level.
    levels: the finest first.
    surroundings: what is far away, in all levels; None where nothing is.
    """

    tree: Node
    levels: tuple[Level, ...]
    surroundings: Gaussians | None

    def parts(self) -> Iterator[tuple[Level, ...]]:
        """The levels of all leaves as one part, as of `Division.parts`."""
        yield self.levels


@dataclass(frozen=True)
class Division:
    """A model whose levels of detail are made part by part, so that memory need not hold all of them.

    gaussians: float32 on the CPU. leaves: the rows of each leaf of `tree`, int64. count: of the levels.
    tree, surroundings: of `Levels`.
    """

    gaussians: Gaussians
    tree: Node
    leaves: tuple[Tensor, ...]
    count: int
    surroundings: Gaussians | None

    def parts(self) -> Iterator[tuple[Level, ...]]:
        """The levels of some leaves at a time, in the order of the tree: runs and errors are those of these leaves."""
        for batch in _batches(self.leaves):
            part = self.gaussians.select(torch.cat(batch))
            moments = moments_of(part)
            groups = torch.repeat_interleave(
                torch.arange(len(batch)), torch.tensor([len(rows) for rows in batch])
            )
            levels = list[Level]()
            for level in range(self.count):
                if level:
                    moments, groups = _reduced(moments, groups, -(-moments.count // RATIO))
                    part = gaussians_of(moments)
                order = _in_runs(part.means, groups)
                counts = torch.bincount(groups, minlength=len(batch))
                firsts = (counts.cumsum(0) - counts).tolist()
                runs = tuple(Run(*run) for run in zip(firsts, counts.tolist(), strict=True))
                levels.append(Level(part.select(order), runs, tuple(_errors(moments, groups, len(batch)))))
            yield tuple(levels)


def make_levels(
    gaussians: Gaussians,
    *,
    coarsest: int = COARSEST,
    leaf: int = LEAF,
    most_surroundings: int = MOST_SURROUNDINGS,
) -> Levels:
    """Return the levels of detail of a model at once; the arguments are those of `divide`."""
    model = divide(gaussians, coarsest=coarsest, leaf=leaf, most_surroundings=most_surroundings)
    return Levels(
        model.tree, tuple(_joined(each) for each in zip(*model.parts(), strict=True)), model.surroundings
    )


def divide(
    gaussians: Gaussians,
    rows: Tensor | None = None,
    *,
    coarsest: int = COARSEST,
    leaf: int = LEAF,
    most_surroundings: int = MOST_SURROUNDINGS,
) -> Division:
    """Divide a model into leaves and surroundings. Each of its levels has a quarter of the Gaussians of the one before.

    gaussians: float32 on the CPU. rows: bool [N], those that are used, all of them finite; None for all.
    coarsest: Gaussians of the last level at most, so that there are 1 + ceil(log4(N / coarsest)) levels.
    leaf: Gaussians of a leaf at level 0, at most. most_surroundings: Gaussians of the surroundings at most.

    Beyond the model, the memory that this and `Division.parts` take has a bound, but for some numbers for each row.
    """
    used = torch.arange(gaussians.count) if rows is None else rows.nonzero()[:, 0]
    far = surroundings(gaussians.means[used], most_surroundings)
    near = used[~far]
    tree, leaves = partition(gaussians.means[near], leaf)
    levels = 0
    while len(near) > coarsest * RATIO**levels:
        levels += 1
    return Division(
        gaussians,
        tree,
        tuple(near[places] for places in leaves),
        levels + 1,
        gaussians.select(used[far]) if bool(far.any()) else None,
    )


def _joined(parts: tuple[Level, ...]) -> Level:
    """A level of all leaves, from that of each part."""
    runs, first = list[Run](), 0
    for part in parts:
        runs += [Run(first + run.first, run.count) for run in part.runs]
        first += part.gaussians.count
    errors = tuple(error for part in parts for error in part.errors)
    return Level(concatenate(*(part.gaussians for part in parts)), tuple(runs), errors)


def surroundings(means: Tensor, most: int) -> Tensor:
    """bool [N]: Gaussians beyond the dense middle of the model, if there are at most `most`; else none.

    They are further than MIDDLE times the median of all distances from the median point, as far shells are.
    """
    if not len(means):
        return torch.zeros(0, dtype=torch.bool)
    distances = torch.linalg.vector_norm(means.double() - means.double().median(0).values, dim=1)
    far = distances > MIDDLE * distances.median()
    return far if int(far.sum()) <= most else torch.zeros_like(far)


def _batches(leaves: Sequence[Tensor]) -> list[list[Tensor]]:
    """The leaves in their order, as many at a time as have _BATCH Gaussians, and at least one."""
    batches: list[list[Tensor]] = []
    count = 0
    for rows in leaves:
        if not batches or count + len(rows) > _BATCH:
            batches.append([])
            count = 0
        batches[-1].append(rows)
        count += len(rows)
    return batches


def _reduced(moments: Moments, groups: Tensor, most: int) -> tuple[Moments, Tensor]:
    """The moments merged in pairs, within groups, until at most `most` are left, and their groups."""
    for turn in range(_MOST_ROUNDS):
        if moments.count <= most:
            break
        first, second = pairs(moments, groups, moments.count - most, turn)
        alone = torch.ones(moments.count, dtype=torch.bool)
        alone[first] = alone[second] = False
        groups = torch.cat([groups[alone], groups[first]])
        order = torch.argsort(groups, stable=True)
        moments, groups = merged(moments, first, second)[order], groups[order]
    return moments, groups


def _in_runs(means: Tensor, groups: Tensor) -> Tensor:
    """Rows by group, in Morton order within each."""
    order = morton_order(means, cubic=True)
    return order[torch.argsort(groups[order], stable=True)]


def _errors(moments: Moments, groups: Tensor, count: int) -> list[float]:
    """The error of each group, world units."""
    sums = torch.zeros(2, count, dtype=torch.float64)
    sums[0].index_add_(0, groups, moments.shapes.masses * moments.spreads)
    sums[1].index_add_(0, groups, moments.shapes.masses)
    errors: list[float] = (sums[0] / sums[1].clamp(min=1e-300)).sqrt().tolist()
    return errors
