"""Gaussians by their moments, in which several are merged into one without a change of the sums.

Source: Kerbl et al., "A Hierarchical 3D Gaussian Representation for Real-Time Rendering of Very Large Datasets" (2024),
section 4.1, which merges by opacity times area. The area here is another one; see `areas`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from splatmill_worker.kernels.reference.project import rotation
from splatmill_worker.splat.gaussians import Gaussians

MOST_OPAQUE = 0.999
"""Opacity that no merged Gaussian exceeds. Where opaque Gaussians overlap, their sum is over 1, and none is seen."""

_LEAST_VARIANCE = 1e-14
"""Of the largest variance of a Gaussian: the smallest, which float64 keeps above zero when eigenvalues are taken."""

_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""The entries of a symmetric matrix that are kept, in their order."""


@dataclass(frozen=True)
class Shapes:
    """N Gaussians without their colours, as the quantities that add up when they are merged, float64.

    masses: [N] opacity times area, square units.
    means: [N, 3] centres, world units.
    covariances: [N, 6] entries xx, xy, xz, yy, yz, zz, square units.
    """

    masses: Tensor
    means: Tensor
    covariances: Tensor

    def __getitem__(self, rows: Tensor | slice) -> Shapes:
        """The rows picked by a slice, a boolean mask [N] or indices."""
        return Shapes(self.masses[rows], self.means[rows], self.covariances[rows])


@dataclass(frozen=True)
class Moments:
    """N Gaussians with their colours, and how far what was merged into them is from their centres.

    shapes: of N.
    sh: [N, D] spherical harmonics, float32.
    spreads: [N] mean squared distance from the centre of the Gaussians of level 0 that were merged into it, by mass,
        square units, float64.
    """

    shapes: Shapes
    sh: Tensor
    spreads: Tensor

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(self.spreads)

    def __getitem__(self, rows: Tensor) -> Moments:
        """The rows picked by a boolean mask [N] or by indices."""
        return Moments(self.shapes[rows], self.sh[rows], self.spreads[rows])


def moments_of(gaussians: Gaussians) -> Moments:
    """The moments of Gaussians of level 0."""
    axes = _axes(gaussians)
    full = axes @ axes.transpose(1, 2)
    covariances = torch.stack([full[:, i, j] for i, j in _PAIRS], 1)
    masses = torch.sigmoid(gaussians.logit_opacities.double()) * areas(covariances)
    shapes = Shapes(masses, gaussians.means.double(), covariances)
    return Moments(shapes, gaussians.sh.flatten(1).float(), torch.zeros_like(masses))


def union(first: Shapes, second: Shapes) -> tuple[Tensor, Tensor]:
    """The masses [M] and covariances [M, 6] of the Gaussians into which those of two rows of M are merged in pairs.

    With the masses m, the shares s = m / (m1 + m2) and the distance d = mean2 - mean1:

        mass = m1 + m2
        mean = s1 mean1 + s2 mean2
        covariance = s1 covariance1 + s2 covariance2 + s1 s2 d d^T

    the first two moments of the mixture (the law of total covariance).
    """
    masses = first.masses + second.masses
    share = second.masses / masses.clamp(min=1e-300)
    x, y, z = ((second.means - first.means) * (share * (1 - share)).sqrt()[:, None]).unbind(1)
    between = torch.stack([x * x, x * y, x * z, y * y, y * z, z * z], 1)
    return masses, torch.lerp(first.covariances, second.covariances, share[:, None]) + between


def merged(moments: Moments, first: Tensor, second: Tensor) -> Moments:
    """The moments with the rows `first` and `second`, int64 [M] each, merged in pairs behind all other rows.

    Shapes are as in `union`; harmonics and spreads are means by mass, to which the spreads add s1 s2 |d|^2.
    """
    alone = torch.ones(moments.count, dtype=torch.bool)
    alone[first] = alone[second] = False
    kept, a, b = moments[alone], moments[first], moments[second]
    masses, covariances = union(a.shapes, b.shapes)
    share = b.shapes.masses / masses.clamp(min=1e-300)
    apart = (b.shapes.means - a.shapes.means).square().sum(1)
    means = torch.lerp(a.shapes.means, b.shapes.means, share[:, None])
    spreads = torch.lerp(a.spreads, b.spreads, share) + share * (1 - share) * apart
    return Moments(
        Shapes(
            torch.cat([kept.shapes.masses, masses]),
            torch.cat([kept.shapes.means, means]),
            torch.cat([kept.shapes.covariances, covariances]),
        ),
        torch.cat([kept.sh, torch.lerp(a.sh, b.sh, share[:, None].float())]),
        torch.cat([kept.spreads, spreads]),
    )


def gaussians_of(moments: Moments) -> Gaussians:
    """The Gaussians with these moments, float32: the opacity is the mass over the area, up to MOST_OPAQUE."""
    shapes = moments.shapes
    full = shapes.covariances.new_zeros(moments.count, 3, 3)
    for place, (i, j) in enumerate(_PAIRS):
        full[:, i, j] = full[:, j, i] = shapes.covariances[:, place]
    variances, axes = torch.linalg.eigh(full)
    axes = axes * torch.where(torch.linalg.det(axes) < 0, -1.0, 1.0)[:, None, None]
    variances = variances.clamp(min=1e-300).maximum(variances[:, 2:] * _LEAST_VARIANCE)
    opacities = (shapes.masses / areas(shapes.covariances).clamp(min=1e-300)).clamp(max=MOST_OPAQUE)
    return Gaussians(
        shapes.means.float(),
        (0.5 * variances.log()).float(),
        quaternions(axes).float(),
        torch.logit(opacities).float(),
        moments.sh.reshape(moments.count, -1, 3),
    )


def areas(covariances: Tensor) -> Tensor:
    """The area that a Gaussian covers in a picture [N], root mean square over all directions, square units.

    Seen along n, that of the ellipse of one standard deviation is pi sqrt(n^T adj(C) n), and the mean of n n^T over all
    directions is a third of the identity. So it is pi sqrt(trace(adj(C)) / 3), without the axes of the Gaussian.
    """
    xx, xy, xz, yy, yz, zz = covariances.unbind(1)
    trace = (yy * zz - yz * yz) + (xx * zz - xz * xz) + (xx * yy - xy * xy)
    return math.pi * (trace.clamp(min=0) / 3).sqrt()


def extents(gaussians: Gaussians) -> Tensor:
    """The standard deviations along the axes of the world [N, 3], world units, float64."""
    return _axes(gaussians).square().sum(2).sqrt()


def _axes(gaussians: Gaussians) -> Tensor:
    """The axes of Gaussians as the columns of [N, 3, 3], each as long as its standard deviation."""
    return rotation(gaussians.quats.double()) * gaussians.log_scales.double().exp()[:, None, :]


def quaternions(matrices: Tensor) -> Tensor:
    """Unit quaternions wxyz [N, 4] of rotation matrices [N, 3, 3].

    Each row of the symmetric matrix 4 q q^T is a multiple of the quaternion; the one with the largest diagonal entry is
    exact to rounding (Shepperd 1978).
    """
    a, b, c, d, e, f, g, h, i = matrices.flatten(1).unbind(1)
    outer = torch.stack(
        [
            torch.stack([1 + a + e + i, h - f, c - g, d - b], 1),
            torch.stack([h - f, 1 + a - e - i, b + d, c + g], 1),
            torch.stack([c - g, b + d, 1 - a + e - i, f + h], 1),
            torch.stack([d - b, c + g, f + h, 1 - a - e + i], 1),
        ],
        1,
    )
    best = outer.diagonal(dim1=1, dim2=2).argmax(1)
    return torch.nn.functional.normalize(outer[torch.arange(len(best)), best], dim=1)
