"""Pruning: removes Gaussians that cannot be seen and those that cover a whole view."""

from __future__ import annotations

import torch
from torch import Tensor

from splatmill_worker.splat.gaussians import Gaussians

MIN_OPACITY = 0.005
"""Opacity at or below which a Gaussian is removed. The paper's value, a little over one grey level."""

MAX_SCREEN = 1.5
"""Half side of a Gaussian in a photo, in halves of the photo's longer side, from which it is removed: it covers the
whole view."""


def keep(gaussians: Gaussians, max_extent: Tensor | None) -> Tensor:
    """The Gaussians that stay, bool [N]. The comparisons are written so that NaN fails them.

    max_extent: largest half side in any photo, [N], as `Engine` has it.
    """
    good = torch.sigmoid(gaussians.logit_opacities) > MIN_OPACITY
    good &= gaussians.finite()
    if max_extent is not None:
        good &= max_extent < MAX_SCREEN
    return good
