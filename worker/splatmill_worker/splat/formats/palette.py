"""Codebooks by weighted k-means: of scalars, and of vectors of spherical harmonics.

Source: Lloyd, "Least squares quantization in PCM" (1982).
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

_SCALAR_PASSES = 24
_COARSE_PASSES, _LOCAL_PASSES, _FULL_PASSES = 6, 8, 1
"""Lloyd's passes over scalars; over rows and cells, over the rows within each cell, over all pairs (decisions: sog)."""

_CHUNK = 512
"""Rows whose distances to all centroids are held at a time: 16 MB for 8,192 centroids, less than most caches."""


def scalar_codebook(values: Tensor, weights: Tensor, size: int = 256) -> Tensor:
    """Return `size` ascending values, float32, with a small weighted squared error from `values` to the nearest one.

    values: [M] finite numbers; weights: [M], not negative. With fewer than `size` different values, the last repeats.
    """
    if not values.numel():
        return torch.zeros(size)
    ordered, at = torch.sort(values.double().flatten())
    mass = weights.double().flatten()[at]
    mass = mass + max(float(mass.sum()), 1e-300) / mass.numel() * 1e-6  # also where every weight is zero
    weight = torch.cat([mass.new_zeros(1), mass.cumsum(0)])
    moment = torch.cat([mass.new_zeros(1), (mass * ordered).cumsum(0)])
    different = torch.unique_consecutive(ordered)
    if different.numel() <= size:
        return torch.cat([different, different[-1:].expand(size - different.numel())]).float()
    # The density of the centroids is that of the data to the power 1/3, the optimum for many centroids.
    cells = torch.linspace(float(ordered[0]), float(ordered[-1]), 4096, dtype=torch.float64)
    dense = torch.diff(weight[torch.searchsorted(ordered, cells)]).clamp(min=0).pow(1 / 3) + 1e-12
    share = torch.cat([dense.new_zeros(1), dense.cumsum(0)]) / dense.sum()
    quantiles = (torch.arange(size, dtype=torch.float64) + 0.5) / size
    book = cells[torch.searchsorted(share, quantiles).clamp(max=cells.numel() - 1)]
    for _ in range(_SCALAR_PASSES):
        edges = torch.searchsorted(ordered, (book[1:] + book[:-1]) / 2)
        edges = torch.cat([edges.new_zeros(1), edges, edges.new_full((1,), ordered.numel())])
        held = weight[edges[1:]] - weight[edges[:-1]]
        means = (moment[edges[1:]] - moment[edges[:-1]]) / held.clamp(min=1e-300)
        book = torch.where(held > 0, means, book).sort().values
    return book.float()


def nearest_scalar(values: Tensor, book: Tensor) -> Tensor:
    """Return the index of the nearest value of an ascending codebook for each of `values`, int64 of their shape."""
    middles = ((book[1:].double() + book[:-1].double()) / 2).contiguous()
    return torch.searchsorted(middles, values.double().contiguous())


def palette(rows: Tensor, weights: Tensor, size: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Return at most `size` centroids [K, D] and the index of the nearest one for each row, int64 [N].

    rows: [N, D] float32; weights: [N], not negative. The weighted squared error is reduced first within the cells of a
    coarse division, then over all rows: for 8,192 centroids, a pass over all pairs costs as much as fifty within cells.
    """
    n = rows.shape[0]
    if n <= size:
        return rows.clone(), torch.arange(n)
    weights = weights.to(torch.float32).clamp(min=0)
    weights = weights / weights.sum().clamp(min=1e-30) * n + 1e-4
    generator = torch.Generator().manual_seed(seed)
    centroids = _in_cells(rows, weights, size, generator)
    labels = torch.empty(0)
    for _ in range(_FULL_PASSES):
        labels, errors = assign(rows, centroids)
        centroids = _refilled(_means(rows, weights, labels, centroids), rows, weights, labels, errors)
    labels, _ = assign(rows, centroids)
    return centroids, labels


def assign(rows: Tensor, centroids: Tensor) -> tuple[Tensor, Tensor]:
    """Return the index of the nearest centroid for each row, int64 [N], and the squared distances to them [N]."""
    half = centroids.square().sum(1)
    turned = centroids.t().contiguous()
    labels = torch.empty(rows.shape[0], dtype=torch.int64)
    errors = torch.empty(rows.shape[0])
    for first in range(0, rows.shape[0], _CHUNK):
        part = rows[first : first + _CHUNK]
        least, index = torch.addmm(half, part, turned, alpha=-2).min(dim=1)
        labels[first : first + _CHUNK] = index
        errors[first : first + _CHUNK] = least + part.square().sum(1)
    return labels, errors.clamp(min=0)


def _means(rows: Tensor, weights: Tensor, labels: Tensor, centroids: Tensor) -> Tensor:
    """The weighted means of the rows with each label; the former centroid where there is none."""
    held = torch.zeros(centroids.shape[0]).index_add_(0, labels, weights)
    sums = torch.zeros_like(centroids).index_add_(0, labels, rows * weights[:, None])
    return torch.where((held > 0)[:, None], sums / held.clamp(min=1e-30)[:, None], centroids)


def _refilled(centroids: Tensor, rows: Tensor, weights: Tensor, labels: Tensor, errors: Tensor) -> Tensor:
    """The centroids, those without a row moved to the rows with the largest weighted errors."""
    empty = torch.bincount(labels, minlength=centroids.shape[0]) == 0
    count = int(empty.sum())
    if count:
        worst = torch.topk(errors * weights, min(count, rows.shape[0])).indices
        centroids[empty.nonzero()[: worst.numel(), 0]] = rows[worst]
    return centroids


def _lloyd(
    rows: Tensor, weights: Tensor, size: int, passes: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    start = torch.multinomial(weights, size, replacement=False, generator=generator)
    centroids = rows[start].clone()
    labels = torch.zeros(rows.shape[0], dtype=torch.int64)
    for _ in range(passes):
        labels, errors = assign(rows, centroids)
        centroids = _refilled(_means(rows, weights, labels, centroids), rows, weights, labels, errors)
    return centroids, labels


def _in_cells(rows: Tensor, weights: Tensor, size: int, generator: torch.Generator) -> Tensor:
    """`size` centroids: each cell of a coarse division is given its share, and divided by itself."""
    cells = max(2, math.isqrt(size))
    coarse, labels = _lloyd(rows, weights, cells, _COARSE_PASSES, generator)
    labels, errors = assign(rows, coarse)
    order = torch.argsort(labels, stable=True)
    counts = torch.bincount(labels, minlength=cells)
    spread = torch.zeros(cells).index_add_(0, labels, errors * weights)
    shares = _shares(spread.double().numpy(), counts.numpy(), size)
    centroids, first = [], 0
    for count, share in zip(counts.tolist(), shares.tolist(), strict=True):
        of_cell = order[first : first + count]
        first += count
        if share == 0:
            continue
        if share >= count:
            centroids.append(rows[of_cell])
        else:
            centroids.append(_lloyd(rows[of_cell], weights[of_cell], share, _LOCAL_PASSES, generator)[0])
    return torch.cat(centroids)


def _shares(spread: Floats, counts: Integers, size: int) -> Integers:
    """How many of `size` centroids each cell gets: in proportion to its error, at most one a row, at least one."""
    shares: Integers = np.minimum(counts, 1)
    while (left := size - shares.sum()) > 0:
        room = counts - shares
        wish = spread * (room > 0)
        if not wish.sum() > 0:
            wish = room.astype(np.float64)
        if not wish.sum() > 0:
            break
        more = np.minimum(room, np.floor(left * wish / wish.sum()).astype(np.int64))
        if not more.sum():
            more = np.zeros_like(room)
            more[np.argsort(-wish)[:left]] = 1
            more = np.minimum(more, room)
        shares = shares + more
    return shares
