"""Frames of file formats: the standard `.ply` has y down and z to the front, `.spz` y up and z to the back."""

from __future__ import annotations

import torch

from splatmill_worker.splat.gaussians import Gaussians

_HARMONICS = (1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1)
"""Signs of the real spherical harmonics of degrees 0 to 3 under y -> -y, z -> -z."""


def turned_about_x(gaussians: Gaussians) -> Gaussians:
    """The scene turned by 180 degrees about x, which leads from right-down-front to right-up-back and back again.

    Means, quaternions and harmonics change signs only, so nothing is rounded.
    """
    flip = gaussians.means.new_tensor([1, -1, -1])
    signs = torch.tensor(
        _HARMONICS[: gaussians.sh.shape[1]], dtype=gaussians.sh.dtype, device=gaussians.sh.device
    )
    return Gaussians(
        gaussians.means * flip,
        gaussians.log_scales,
        gaussians.quats * gaussians.quats.new_tensor([1, 1, -1, -1]),
        gaussians.logit_opacities,
        gaussians.sh * signs[:, None],
    )
