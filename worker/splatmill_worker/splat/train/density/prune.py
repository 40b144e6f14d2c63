"""Which Gaussians go: those that cannot be seen, and those that have outgrown what they describe."""

from __future__ import annotations

import torch
from torch import Tensor

from splatmill_worker.splat.gaussians import Gaussians

MIN_OPACITY = 0.005
"""As in the paper: a little over one grey level."""

MAX_SCREEN = 1.5
"""Half size over half the photo's longer side: beyond it a Gaussian is a veil over the whole view."""


def keep(gaussians: Gaussians, max_extent: Tensor | None, *, min_opacity: float = MIN_OPACITY) -> Tensor:
    """bool [N]: rows that stay. The comparisons are written so that NaN fails them."""
    good = torch.sigmoid(gaussians.logit_opacities) > min_opacity
    good &= gaussians.finite()
    if max_extent is not None:
        good &= max_extent < MAX_SCREEN
    return good
