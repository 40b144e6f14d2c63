"""The largest eigenvalue of a symmetric operator that is known by its products (Lanczos 1950, Paige 1972)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor


class Largest(NamedTuple):
    """The largest eigenvalue and its unit vector, as far as they were found.

    value: the Ritz value, a lower bound on the largest eigenvalue (of an operator that is exactly symmetric).
    vector: of the shape of the start.
    error: the residual's norm; an eigenvalue lies within this distance of `value`.
    products: how many were taken.
    values, weights: all Ritz values, and the squares of the start's components along them. For a random start, the
        weights above some level estimate the share of eigenvalues above it (Ubaru, Chen & Saad 2017).
    """

    value: float
    vector: Tensor
    error: float
    products: int
    values: Tensor
    weights: Tensor

    def share_above(self, level: float) -> float:
        """The estimated share of eigenvalues above `level`."""
        return float(self.weights[self.values > level].sum())


def largest(
    product: Callable[[Tensor], Tensor],
    start: Tensor,
    *,
    tolerance: float = 0.02,
    most: int = 40,
    least: int = 1,
) -> Largest:
    """The largest eigenvalue of `product`, to a relative residual of `tolerance`, in `least` to `most` products.

    start: float64 of any shape, not 0. All vectors are kept and orthogonalised twice, so that no copies of an
    eigenvalue appear.
    """
    shape = start.shape
    basis = [start.reshape(-1) / start.norm()]
    diagonal: list[float] = []
    off: list[float] = []
    while True:
        w = product(basis[-1].reshape(shape)).reshape(-1)
        diagonal.append(float(w @ basis[-1]))
        kept = torch.stack(basis)
        for _ in range(2):
            w = w - kept.T @ (kept @ w)
        beta = float(w.norm())
        values, vectors = torch.linalg.eigh(_tridiagonal(diagonal, off))
        error = beta * abs(float(vectors[-1, -1]))
        value = float(values[-1])
        enough = error <= tolerance * abs(value) and len(diagonal) >= least
        done = enough or len(diagonal) >= min(most, len(w))
        if done or beta <= 1e-12 * float(values.abs().max()):
            top = (vectors[:, -1] @ kept).reshape(shape)
            return Largest(value, top, error, len(diagonal), values, vectors[0] ** 2)
        off.append(beta)
        basis.append(w / beta)


def _tridiagonal(diagonal: list[float], off: list[float]) -> Tensor:
    middle = torch.diag(torch.tensor(diagonal, dtype=torch.float64))
    if not off:
        return middle
    side = torch.tensor(off, dtype=torch.float64)
    return middle + torch.diag(side, 1) + torch.diag(side, -1)
