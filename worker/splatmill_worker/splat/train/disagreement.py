"""How far each training photo disagrees with those around it, and what that looks like.

The photos are compared in the course of a run. At its end, a long one has over-fitted to what single photos show.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Literal, NamedTuple

from torch import Tensor

from splatmill_worker.images.transparency import SOLID
from splatmill_worker.splat.train.consensus import Comparison, Glance, compared, glance, small
from splatmill_worker.splat.train.renderer import evaluation_background
from splatmill_worker.splat.train.run import TrainingRun

Reason = Literal["moving things", "other light", "wrong camera or blur", "not cut out"]
"""What makes a photo disagree with the others."""

VISITS = 10
"""Steps on each photo after which the photos are compared: what all show is learnt by then, and what one photo alone
shows is not yet (decisions: disagreement)."""

LATEST = 0.3
"""Share of the budget after which they are compared in any case, before the rates fall (decisions: disagreement)."""

FEWEST_PHOTOS = 3
"""Photos below which none has two others to be compared with."""

OTHER_LIGHT = 3.0
"""dB that a fit of its colours gains on a photo with another light."""

WHOLLY_OFF = 1.3
"""A photo has a wrong camera or is blurred where its residuals are this many times those of the others by two measures:
the median over its pixels, relative to that of the median photo, and the root mean square (decisions: disagreement)."""

WHOLLY_OFF_DB = 20.0 * math.log10(WHOLLY_OFF)
"""The same in decibels: 2.3."""

THING = 0.01
"""Share of a photo's pixels that no other agrees with, from which it is named (decisions: disagreement)."""


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


class Look:
    """Compares the photos of a run once, in its course: those that are not set aside when it begins or continues.

    seconds: what the comparison took.
    """

    def __init__(self, run: TrainingRun) -> None:
        self._run = run
        self._compared = [index for index in range(len(run.views)) if index not in run.set_aside]
        self._disagreements: tuple[Disagreement, ...] | None = None
        self.seconds = 0.0

    def is_due(self, run: TrainingRun) -> bool:
        """Whether to compare them now. A run that continues from a checkpoint compares them again."""
        return self._disagreements is None and (
            run.state.step >= VISITS * len(self._compared) or run.progress >= LATEST
        )

    def observe(self, run: TrainingRun) -> None:
        """Compare the photos with what the run's engine holds."""
        started = time.perf_counter()
        self._disagreements = disagreements(run, self._compared)
        self.seconds = time.perf_counter() - started

    def finish(self) -> tuple[Disagreement, ...]:
        """What was found; of the end of the run where it ended before the photos were compared."""
        if self._disagreements is None:
            self.observe(self._run)
        return self._disagreements or ()


def disagreements(run: TrainingRun, learnt: Sequence[int]) -> tuple[Disagreement, ...]:
    """The photos with the indices `learnt`, the one that disagrees most first; none where they are too few to compare.

    Photos that no step was taken on would disagree for that reason alone.
    """
    views = [run.views[index] for index in learnt]
    if len(views) < FEWEST_PHOTOS:
        return ()
    background = evaluation_background(run.plan, run.views)
    targets = [small(view) for view in views]
    if run.poses is not None:
        moved = [run.poses.viewmat(index) for index in learnt]
        targets = [target._replace(viewmat=viewmat) for target, viewmat in zip(targets, moved, strict=True)]
    glances = [glance(run.engine, run.plan, target, background) for target in targets]
    comparisons = compared(glances)
    usual = sorted(comparison.median for comparison in comparisons)[len(comparisons) // 2]
    cut_out = [view.full.alpha is not None and int(view.full.alpha.min()) < SOLID for view in views]
    judged = [
        _judged(view.name, glance, comparison, usual, whole=not cut and 2 * sum(cut_out) > len(views))
        for view, glance, comparison, cut in zip(views, glances, comparisons, cut_out, strict=True)
    ]
    return tuple(sorted(judged, key=lambda each: -each.decibels))


def _judged(name: str, glance: Glance, comparison: Comparison, usual: float, *, whole: bool) -> Disagreement:
    """whole: whether the photo is opaque, and most of the others are cut out: their light is not what differs."""
    share = float(comparison.outliers.float().mean())
    reason: Reason | None = None
    if whole and (glance.light >= OTHER_LIGHT or comparison.decibels > 0.0):
        reason = "not cut out"
    elif glance.light >= OTHER_LIGHT:
        reason = "other light"
    elif comparison.decibels <= 0.0:
        reason = None
    elif comparison.decibels >= WHOLLY_OFF_DB and 0.0 < WHOLLY_OFF * usual <= comparison.median:
        reason = "wrong camera or blur"
    elif share >= THING:
        reason = "moving things"
    return Disagreement(name, comparison.decibels, share, reason, comparison.outliers)
