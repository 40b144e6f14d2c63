"""Steps on a random part of the Gaussians, so that none learns to cover up what the others show wrongly in one photo.

Park et al., "DropGaussian: Structural Regularization for Sparse-view Gaussian Splatting", CVPR 2025.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

TRANSPARENT = -20.0
"""Logit of the opacity of a Gaussian that is left out: 2e-9, which no kernel blends."""

MOST_OPAQUE = 0.999
"""Opacity up to which the others are raised; at 1 the logit would be infinite."""


@contextmanager
def dropout(logit_opacities: Tensor, share: float, seed: int) -> Iterator[None]:
    """Leave a random `share` of the Gaussians, 0 to below 1, out of the step that is taken in the `with` block.

    logit_opacities: the engine's own, in any layout; written to. The opacities of the others are divided by 1 - share,
    so that the expected opacity of each stays. Afterwards, and after an error, each logit is what it was before, moved
    by as much as the step moved it.
    seed: of the choice; the same one always makes the same choice on the same kind of device.
    """
    if share <= 0.0:
        yield
        return
    before = logit_opacities.clone()
    random = torch.Generator(before.device).manual_seed(seed)
    gone = torch.rand(before.shape, generator=random, device=before.device) < share
    raised = torch.logit((torch.sigmoid(before) / (1.0 - share)).clamp_max_(MOST_OPAQUE))
    meanwhile = torch.maximum(raised, before).masked_fill_(gone, TRANSPARENT)
    logit_opacities.copy_(meanwhile)
    try:
        yield
    finally:
        logit_opacities.sub_(meanwhile).add_(before)
