"""How far each training photo disagrees with those around it, at the end of a run, and what that looks like."""

from __future__ import annotations

from typing import Literal, NamedTuple

from torch import Tensor

from splatmill_worker.splat.train.consensus import Comparison, Glance, compared, glance, small
from splatmill_worker.splat.train.renderer import evaluation_background
from splatmill_worker.splat.train.run import TrainingRun

Reason = Literal["moving things", "other light", "wrong camera or blur"]
"""What makes a photo disagree with the others."""

FEWEST_PHOTOS = 3
"""Photos below which none has two others to be compared with."""

OTHER_LIGHT = 3.0
"""dB that a fit of its colours gains on a photo with another light."""

WHOLLY_OFF = 1.3
"""Median ratio of a photo's residuals to those of the others, over the same of the median photo, from which no thing in
it is the reason: half of the photo is worse (decisions: disagreement)."""

THING = 0.01
"""Share of a photo's pixels that no other agrees with, from which it is named, if its residuals are larger than the
others' too (decisions: disagreement)."""


class Disagreement(NamedTuple):
    """How far a training photo disagrees with those around it.

    name: of the photo.
    decibels: its residuals over those that the other photos have at the same places, root mean square, dB.
    share: of its pixels that no other photo agrees with, 0 to 1.
    reason: what the disagreement looks like; None where it is small.
    outliers: pixels that no other photo agrees with, bool [h, w], a small fraction of the photo's size.
    """

    name: str
    decibels: float
    share: float
    reason: Reason | None
    outliers: Tensor


def disagreements(run: TrainingRun) -> tuple[Disagreement, ...]:
    """All training photos of a run, that which disagrees most first; none where there are too few to be compared."""
    if len(run.views) < FEWEST_PHOTOS:
        return ()
    background = evaluation_background(run.plan, run.views)
    targets = [small(view) for view in run.views]
    if run.poses is not None:
        targets = [target._replace(viewmat=run.poses.viewmat(index)) for index, target in enumerate(targets)]
    glances = [glance(run.engine, run.plan, target, background) for target in targets]
    found = compared(glances)
    usual = sorted(comparison.median for comparison in found)[len(found) // 2]
    judged = [
        _judged(view.name, seen, comparison, usual)
        for view, seen, comparison in zip(run.views, glances, found, strict=True)
    ]
    return tuple(sorted(judged, key=lambda each: -each.decibels))


def _judged(name: str, seen: Glance, comparison: Comparison, usual: float) -> Disagreement:
    share = float(comparison.outliers.float().mean())
    reason: Reason | None = None
    if seen.light >= OTHER_LIGHT:
        reason = "other light"
    elif usual > 0.0 and comparison.median >= WHOLLY_OFF * usual:
        reason = "wrong camera or blur"
    elif share >= THING and comparison.decibels > 0.0:
        reason = "moving things"
    return Disagreement(name, comparison.decibels, share, reason, comparison.outliers)
