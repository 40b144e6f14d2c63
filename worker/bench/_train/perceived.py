"""Errors of held-out views as people see them, beside PSNR, SSIM and LPIPS: FLIP and MS-SSIM.

Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", 2020; Wang et al., "Multi-scale structural
similarity for image quality assessment", 2003.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from _rows import Row
from flip_evaluator import flip_python_api as flip
from pytorch_msssim.ssim import ms_ssim

from splatmill_worker.splat.evaluate import Renderer
from splatmill_worker.splat.views import TrainingView

LEAST_SIDE = 161
"""Least pixels of the shorter side for MS-SSIM, whose window of 11 pixels has to fit into a sixteenth of it."""


def perceived(render: Renderer, views: Sequence[TrainingView], background: torch.Tensor) -> Row:
    """The means over the views of FLIP, 0 for equal pictures, and of MS-SSIM, 1 for them.

    FLIP is for a screen of 67 pixels per degree, its own default. None where there are no views, where one of them is
    masked, and for MS-SSIM where one is smaller than LEAST_SIDE.
    """
    if not views or any(view.full.mask is not None for view in views):
        return {"flip": None, "ms_ssim": None}
    flips, similarities = [], []
    for view in views:
        shown = render(view.full, background).detach().float().cpu().clamp(0.0, 1.0)
        photo = view.full.over(background).float().cpu() / 255.0
        _, error, _ = flip.evaluate(photo.numpy(), shown.numpy(), "LDR", applyMagma=False)
        flips.append(float(error))
        if min(photo.shape[:2]) >= LEAST_SIDE:
            planes = [picture.permute(2, 0, 1)[None] for picture in (shown, photo)]
            similarities.append(float(ms_ssim(planes[0], planes[1], data_range=1.0)))
    return {"flip": _mean(flips, len(views)), "ms_ssim": _mean(similarities, len(views))}


def _mean(values: Sequence[float], views: int) -> float | None:
    """The mean of the values; None where a view has none."""
    return sum(values) / views if len(values) == views else None
