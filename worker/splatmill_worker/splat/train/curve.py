"""The curve of error against run time, and what its last doubling of the steps has gained."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

GAIN_POINTS = 2
"""Points of the curve that must lie in the second half of the steps. One point is no evidence: the curve dips where
Gaussians were just added or the photos became larger."""

GAIN_FROM = 500
"""Steps before which a gain says nothing about those to come."""


@dataclass(frozen=True)
class CurvePoint:
    """One evaluation during training. A rise of train_psnr with a fall of psnr is over-fitting.

    seconds: training time so far; evaluations and checkpoints are not counted.
    step: training steps so far.
    loss: training loss of the last step.
    psnr: dB, mean over the held-out views; None where there are none.
    ssim: mean over the held-out views, 0 to 1; None where there are none.
    gaussians: how many the scene had.
    memory: resident size of the process, bytes.
    train_psnr: dB, mean over a few training views.
    train_ssim: mean over the same training views, 0 to 1.
    views: number of held-out views that were evaluated; None where there are none. The last point shows all of them.
    validation_psnr: dB, mean over the photos that are set aside; None where none are, or they are trained on again.
    """

    seconds: float
    step: int
    loss: float
    psnr: float | None
    ssim: float | None
    gaussians: int
    memory: int | None = None
    train_psnr: float | None = None
    train_ssim: float | None = None
    views: int | None = None
    validation_psnr: float | None = None


def validated(curve: Sequence[CurvePoint], since: int = 0) -> list[tuple[int, float]]:
    """Step and validation PSNR, dB, of the points after step `since` that have one.

    since: last step on reduced photos, where scenes are to be compared: they fit photos of one size.
    """
    return [
        (point.step, point.validation_psnr)
        for point in curve
        if point.validation_psnr is not None and point.step > since
    ]


def last_gain(scores: Sequence[tuple[int, float]]) -> float | None:
    """dB by which the mean of the `validated` scores in the second half of the steps exceeds that in the quarter
    before; None where it is not known yet (decisions: last-gain).
    """
    if not scores or scores[-1][0] < GAIN_FROM:
        return None
    half = scores[-1][0] / 2
    before = [psnr for step, psnr in scores if half / 2 < step <= half]
    after = [psnr for step, psnr in scores if step > half]
    return fmean(after) - fmean(before) if before and len(after) >= GAIN_POINTS else None
