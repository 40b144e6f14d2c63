"""The curve of error against run time, and when it has become flat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

FLAT_GAIN = 0.02
"""dB on the validation photos: a smaller gain over FLAT_SHARE of the training time counts as none."""

FLAT_SHARE = 0.4
"""Share of the training time so far over which the gain is looked at."""

FLAT_POINTS = 3
"""Points of the curve that must lie in that share. One point is no evidence: the curve dips where Gaussians were just
added or the photos became larger."""

FLAT_FROM = 500
"""Steps before which a curve is not called flat."""


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


def is_flat(curve: Sequence[CurvePoint]) -> bool:
    """Whether every point in the last FLAT_SHARE of the time is less than FLAT_GAIN above the best one before it."""
    scores = [(point.seconds, point.validation_psnr) for point in curve if point.validation_psnr is not None]
    if not scores or curve[-1].step < FLAT_FROM:
        return False
    since = (1.0 - FLAT_SHARE) * scores[-1][0]
    before = [psnr for seconds, psnr in scores if seconds <= since]
    after = [psnr for seconds, psnr in scores if seconds > since]
    return bool(before) and len(after) >= FLAT_POINTS and max(after) < max(before) + FLAT_GAIN
