"""The parameters of a scene: one row per Gaussian, in the units that training optimises."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields

import torch
from torch import Tensor

SH_C0 = 0.28209479177387814
"""Zeroth real spherical harmonic: colour = 0.5 + SH_C0 * dc at degree 0."""

REST_COEFFICIENTS = {0: 0, 1: 3, 2: 8, 3: 15}
"""Coefficients above the DC term per colour channel, by SH degree."""


_ROWS = 2**18
"""Rows that are tested at a time: the intermediate results for all rows would take as much memory as the parameters."""


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians as unconstrained parameters (Kerbl et al. 2023, section 4).

    means: [N, 3] centres, world units.
    log_scales: [N, 3] natural logarithm of the standard deviations along the Gaussian's axes, world units.
    quats: [N, 4] rotations as wxyz, of any norm above zero.
    logit_opacities: [N].
    sh: [N, (degree + 1)^2, 3] spherical harmonics by coefficient, then channel; the DC coefficient comes first.

    All five share one dtype and device. Raises ValueError for other shapes.
    """

    means: Tensor
    log_scales: Tensor
    quats: Tensor
    logit_opacities: Tensor
    sh: Tensor

    def __post_init__(self) -> None:
        n = self.means.shape[0]
        expected = {"means": (n, 3), "log_scales": (n, 3), "quats": (n, 4), "logit_opacities": (n,)}
        for name, shape in expected.items():
            actual = tuple(getattr(self, name).shape)
            if actual != shape:
                raise ValueError(
                    f"{name} has shape {actual} where {shape} is needed; pass one row per Gaussian."
                )
        if (
            self.sh.ndim != 3
            or self.sh.shape[0] != n
            or self.sh.shape[2] != 3
            or self.sh.shape[1] not in (1, 4, 9, 16)
        ):
            raise ValueError(
                f"sh has shape {tuple(self.sh.shape)} where ({n}, K, 3) with K of 1, 4, 9 or 16 is needed."
            )

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return int(self.means.shape[0])

    @property
    def degree(self) -> int:
        """Spherical-harmonics degree that `sh` has room for, 0 to 3."""
        return {1: 0, 4: 1, 9: 2, 16: 3}[int(self.sh.shape[1])]

    def parameters(self) -> dict[str, Tensor]:
        """The five tensors by name, in declaration order."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    def __iter__(self) -> Iterator[Tensor]:
        return iter(self.parameters().values())

    def map(self, function: Callable[[Tensor], Tensor]) -> Gaussians:
        """The Gaussians with `function` applied to each of the five tensors."""
        return Gaussians(**{name: function(value) for name, value in self.parameters().items()})

    def select(self, rows: Tensor | slice) -> Gaussians:
        """The rows picked by a boolean mask [N], by indices, or without a copy by a slice."""
        return self.map(lambda value: value[rows])

    def most_opaque(self, limit: int) -> Gaussians:
        """The `limit` most opaque rows, in their order; all of them where there are no more."""
        if self.count <= limit:
            return self
        order = torch.argsort(self.logit_opacities, descending=True, stable=True)
        return self.select(torch.sort(order[:limit]).values)

    def finite(self) -> Tensor:
        """bool [N]: rows whose every parameter is finite and whose quaternion has a direction."""
        keep: Tensor = torch.linalg.vector_norm(self.quats, dim=1) > 0
        for value in self:
            rows = value.unsqueeze(-1).flatten(1)
            for first in range(0, self.count, _ROWS):
                keep[first : first + _ROWS] &= torch.isfinite(rows[first : first + _ROWS]).all(dim=1)
        return keep

    def padded(self, degree: int) -> Gaussians:
        """The same Gaussians at SH degree `degree`: coefficients of zero are added, or higher ones cut off."""
        coefficients = (degree + 1) ** 2
        have = self.sh.shape[1]
        if coefficients <= have:
            sh = self.sh[:, :coefficients]
        else:
            sh = torch.cat([self.sh, self.sh.new_zeros(self.count, coefficients - have, 3)], dim=1)
        return Gaussians(self.means, self.log_scales, self.quats, self.logit_opacities, sh)

    def moved(self, scale: float, translation: Tensor) -> Gaussians:
        """The scene under x -> scale * x + translation (no rotation, so SH stays as it is).

        The result has the dtype of the input. The arithmetic is float64, because a geo-referenced translation in
        float32 is only exact to about half a unit.
        """
        means = (self.means.double() * scale + translation.double()).to(self.means.dtype)
        log_scales = (self.log_scales.double() + torch.tensor(scale, dtype=torch.float64).log()).to(
            self.log_scales.dtype
        )
        return Gaussians(means, log_scales, self.quats, self.logit_opacities, self.sh)


def concatenate(*parts: Gaussians) -> Gaussians:
    """All rows of `parts`, one after the other; they must share the SH degree."""
    return Gaussians(*(torch.cat(group) for group in zip(*parts, strict=True)))
