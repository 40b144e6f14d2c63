"""Gaussians to the image plane: activations, covariance factor, EWA projection, exact extents, SH colour."""

from __future__ import annotations

import torch
from torch import Tensor

from ..records import ALPHA_MIN, BLUR, COMPENSATION_MIN, Projected
from .harmonics import sh_basis


def project(
    means: Tensor,
    log_scales: Tensor,
    quats: Tensor,
    logit_opacities: Tensor,
    sh: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    degree: int,
    near: float = 0.01,
    antialias: bool = False,
) -> Projected:
    """Project Gaussians into one pinhole camera (EWA splatting, Zwicker et al. 2002; Kerbl et al. 2023).

    means [N,3] world; log_scales [N,3]; quats [N,4] wxyz of any norm > 0; logit_opacities [N]; sh [N, >=
    (degree+1)^2, 3]; viewmat [4,4] world to camera with OpenCV axes; K [3,3] pixels, without skew. Gradients reach all
    of them but K.

    A Gaussian is culled, with every field and gradient exactly 0, unless every parameter that is read is finite, its
    quaternion is not 0, z > near, its opacity exceeds 1/255, its projected covariance and colour are finite in this
    dtype, and the box of its 1/255 ellipse reaches the image. Every test is a comparison that NaN fails.
    """
    used = (degree + 1) ** 2
    groups = (means, log_scales, quats, logit_opacities, sh[:, :used])
    with torch.no_grad():
        every = _project_all(*groups, viewmat, K, width, height, degree, antialias)
        kept = torch.nonzero(_kept(groups, every, width, height, near)).squeeze(1)
    visible = (means[kept], log_scales[kept], quats[kept], logit_opacities[kept], groups[4][kept])
    rows = _project_all(*visible, viewmat, K, width, height, degree, antialias)
    n = means.shape[0]

    def spread(x: Tensor) -> Tensor:
        return torch.zeros((n, *x.shape[1:]), dtype=x.dtype, device=x.device).index_copy(0, kept, x)

    return Projected(*(spread(x) for x in rows))._replace(extents=spread(rows.extents).detach())


def _project_all(
    means: Tensor,
    log_scales: Tensor,
    quats: Tensor,
    logit_opacities: Tensor,
    sh: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    degree: int,
    antialias: bool,
) -> Projected:
    W, t = viewmat[:3, :3], viewmat[:3, 3]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    points = means @ W.T + t
    z = points[:, 2]
    u, v = points[:, 0] / z, points[:, 1] / z
    means2d = torch.stack([fx * u + cx, fy * v + cy], 1)

    # Far off-axis the linearised projection stretches without bound; it is evaluated at most 15 % outside the image.
    uc = u.clamp(-(0.15 * width + cx) / fx, (1.15 * width - cx) / fx)
    vc = v.clamp(-(0.15 * height + cy) / fy, (1.15 * height - cy) / fy)
    row0 = (fx / z)[:, None] * (W[0] - uc[:, None] * W[2])  # first row of J W
    row1 = (fy / z)[:, None] * (W[1] - vc[:, None] * W[2])
    factor = rotation(quats) * torch.exp(log_scales)[:, None, :]  # R S
    m0 = torch.einsum("ni,nij->nj", row0, factor)
    m1 = torch.einsum("ni,nij->nj", row1, factor)

    tr0, tr1 = (m0 * m0).sum(1), (m1 * m1).sum(1)
    a, b, c = tr0 + BLUR, (m0 * m1).sum(1), tr1 + BLUR
    # Cauchy-Binet on the factor: a*c - b*b loses every digit for needles, the sum of squared minors loses none.
    sharp = (torch.linalg.cross(m0, m1) ** 2).sum(1)
    det = sharp + BLUR * (tr0 + tr1) + BLUR * BLUR
    conics = torch.stack([c / det, -b / det, a / det], 1)

    opacities = torch.sigmoid(logit_opacities)
    if antialias:
        # Detached: through det, the gradient explodes for splats that degenerate, and drives others there.
        opacities = opacities * torch.sqrt((sharp / det).detach().clamp_min(COMPENSATION_MIN))
    reach = torch.sqrt(2.0 * torch.log(opacities.detach() / ALPHA_MIN).clamp_min(0.0))  # standard deviations
    extents = reach[:, None] * torch.sqrt(torch.stack([a, c], 1).detach())

    direction = means + W.T @ t  # mean - camera centre
    direction = direction / torch.linalg.vector_norm(direction, dim=1, keepdim=True)
    colors = (0.5 + torch.einsum("nk,nkc->nc", sh_basis(direction, degree), sh)).clamp_min(0.0)
    return Projected(means2d, conics, opacities, colors, z, extents)


def _kept(groups: tuple[Tensor, ...], p: Projected, width: int, height: int, near: float) -> Tensor:
    keep = (p.depths > near) & (p.opacities > ALPHA_MIN)
    for group in groups:
        keep = (
            keep & torch.isfinite(group).flatten(1).all(1)
            if group.dim() > 1
            else keep & torch.isfinite(group)
        )
    for field in (p.means2d, p.conics, p.colors, p.depths[:, None], p.extents):
        keep = keep & torch.isfinite(field).all(1)
    (x, y), (ex, ey) = p.means2d.unbind(1), p.extents.unbind(1)
    return keep & (ex > 0) & (ey > 0) & (x + ex > 0) & (x - ex < width) & (y + ey > 0) & (y - ey < height)


def rotation(quats: Tensor) -> Tensor:
    """Return the rotation matrices [N,3,3] of quaternions wxyz [N,4] of any norm > 0; NaN for a zero quaternion."""
    largest = (
        quats.detach().abs().amax(1, keepdim=True)
    )  # scaled first, because the square of 1e-30 is 0 in float32
    scaled = quats / largest
    w, x, y, z = (scaled / torch.linalg.vector_norm(scaled, dim=1, keepdim=True)).unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, 1).reshape(-1, 3, 3)
