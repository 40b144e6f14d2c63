"""Removal of Gaussians that the photos do not support: the most harmful first, while the model comes nearer to them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import torch
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.splat.evaluate import psnr
from splatmill_worker.splat.evidence import HALF_LEVEL, Evidence, evidence_of
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.render import render

if TYPE_CHECKING:
    from splatmill_worker.splat.views import Target

Reason = Literal["needle", "giant", "floater", "island", "other"]
"""What an unsupported Gaussian looks like. It names what was removed, and decides nothing."""

GIANT = 0.5
"""Half side of a Gaussian's box in a photo, in halves of the photo's longer side, from which it counts as a giant."""

NEEDLE = 10.0
"""Longest over second longest axis from which a Gaussian counts as a needle."""

ISLAND = 3.0
"""Mean distance to the three nearest Gaussians, in standard deviations along the longest axis, from which a Gaussian
counts as an island: it ends before the others begin."""

FLOATER = 0.5
"""Depth over that of what a photo shows at the same pixels up to which a Gaussian counts as a floater."""

MOST_LOST = 0.02
"""dB of PSNR that all removals together may cost any one of the photos. With a bound on each of them, and not on their
mean, held-out photos lost less in trials; it does not bound what they lose (decisions: cleaning)."""

FIRST_SHARE = 1e-3
"""Share of the Gaussians that are removed first, at least one; each further time, up to twice as many."""

RETRIED_SHARE = 0.125
"""Share of a removal that is tried in its place where it was refused."""

MOST_REFUSED = 8
"""Removals that may be refused before cleaning ends; each costs a look at all photos."""

LEAST_HARM = 3.0 * HALF_LEVEL**2
"""Squared error of all photos up to which a Gaussian does no harm: that of the rounding to 8 bits at one pixel."""

COMPARABLE = 0.25
"""Harm of a Gaussian over the largest there is, up from which it goes at the same time. A smaller one may be of the
larger one's making, and is seen anew without it (decisions: cleaning)."""


@dataclass(frozen=True)
class Cleaning:
    """What was removed from a model of N Gaussians.

    keep: bool [N], the Gaussians that stay.
    removed: number of Gaussians by what they look like, with all reasons.
    unsupported: number of Gaussians without which the photos would fit better, each taken alone.
    psnr_before, psnr: mean over the photos, dB, before and after, with opacities as in `Evidence.psnr`.
    """

    keep: Tensor
    removed: dict[Reason, int]
    unsupported: int
    psnr_before: float
    psnr: float


def clean(
    gaussians: Gaussians,
    photos: Sequence[Target],
    background: Tensor,
    *,
    antialias: bool = False,
    backend: ops.Backend | None = None,
) -> Cleaning:
    """Find the Gaussians to remove from a model, by the evidence of `photos`, which have to be at least one.

    A Gaussian is unsupported where all photos together have less squared error without it. That does not add up: of two
    that make the same place too bright, one may have to stay. So the most harmful are removed first, the evidence is
    taken anew, and up to twice as many follow, as long as the mean PSNR of the photos rises and none has lost more than
    MOST_LOST. Where not, fewer are tried; one that is refused by itself stays, such as a thing that passed by one
    photo, and the others are tried without it. A model without unsupported Gaussians stays as it is.

    background: RGB [3] in 0 to 1 behind the scene and behind transparent photos.
    antialias: whether the model was trained with the compensation of opacities.
    backend: the kernels; chosen by the tensors' device where None.
    """

    def evidence_for(rows: Tensor) -> Evidence:
        return evidence_of(gaussians.select(rows), photos, background, antialias=antialias, backend=backend)

    rows = torch.arange(gaussians.count, device=gaussians.means.device)
    batch = max(1, math.ceil(FIRST_SHARE * gaussians.count))
    evidence = first = evidence_for(rows)
    removed: dict[Reason, int] = dict.fromkeys(get_args(Reason), 0)
    stays = torch.zeros_like(rows, dtype=torch.bool)
    refused = 0
    while len(rows) and refused < MOST_REFUSED:
        harm = torch.where(stays[rows], 0.0, -evidence.support)
        going = (harm > LEAST_HARM) & (harm >= COMPARABLE * harm.max())
        if not bool(going.any()):
            break
        going[torch.argsort(harm, descending=True, stable=True)[batch:]] = False
        left = rows[~going]
        trial = evidence_for(left)
        if trial.psnr > evidence.psnr and bool((trial.psnrs >= first.psnrs - MOST_LOST).all()):
            for reason, number in _by_reason(gaussians.select(rows), evidence, going).items():
                removed[reason] += number
            rows, evidence, batch = left, trial, 2 * batch
            continue
        refused += 1
        if int(going.sum()) == 1:
            stays[rows[going]] = True
        batch = max(1, int(RETRIED_SHARE * int(going.sum())))
    keep = torch.zeros(gaussians.count, dtype=torch.bool, device=rows.device)
    keep[rows] = True
    return Cleaning(keep, removed, int((first.support < 0.0).sum()), first.psnr, evidence.psnr)


def _by_reason(gaussians: Gaussians, evidence: Evidence, removed: Tensor) -> dict[Reason, int]:
    """How many of the removed ones look like what; each counts once, for the first that it looks like."""
    axes = gaussians.log_scales.exp().sort(dim=1, descending=True).values
    apart = ops.knn(gaussians.means.contiguous()) if gaussians.count > 3 else torch.zeros_like(axes[:, 0])
    looks: dict[Reason, Tensor] = {
        "needle": axes[:, 0] >= NEEDLE * axes[:, 1],
        "giant": evidence.extent >= GIANT,
        "floater": evidence.depth <= FLOATER,
        "island": apart >= ISLAND * axes[:, 0],
        "other": torch.ones_like(removed),
    }
    left, counts = removed.clone(), {}
    for reason, like in looks.items():
        counts[reason] = int((left & like).sum())
        left &= ~like
    return counts


def photo_psnr(
    gaussians: Gaussians,
    target: Target,
    background: Tensor,
    antialias: bool = False,
    backend: ops.Backend | None = None,
) -> float:
    """PSNR in dB of a model's view against its photo, over the pixels that count; arguments as of `clean`."""
    with torch.no_grad():
        color = render(
            gaussians, target.camera, background=background, antialias=antialias, backend=backend
        ).color.clamp(0.0, 1.0)
    photo = target.over(background.cpu()).to(color.device, color.dtype) / 255.0
    error = (color - photo).square().mean(dim=2)
    if target.mask is not None and bool(target.mask.any()):
        error = error[target.mask.to(color.device)]
    return psnr(float(error.double().mean()))
