"""Real spherical harmonics to degree 3, with the signs and order of splat files."""

from __future__ import annotations

import torch
from torch import Tensor


def sh_basis(direction: Tensor, degree: int) -> Tensor:
    """Return the values [N, (degree+1)^2] of the basis at unit directions [N,3] (Sloan 2008)."""
    x, y, z = direction.unbind(1)
    basis = [torch.full_like(x, 0.28209479177387814)]
    if degree > 0:
        c = 0.4886025119029199
        basis += [-c * y, c * z, -c * x]
    if degree > 1:
        xx, yy, zz = x * x, y * y, z * z
        c = 1.0925484305920792
        basis += [
            c * x * y,
            -c * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -c * x * z,
            0.5462742152960396 * (xx - yy),
        ]
    if degree > 2:
        basis += [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]
    return torch.stack(basis, 1)
