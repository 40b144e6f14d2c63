"""How fast this machine trains this scene, measured by a few steps with learning rates of zero."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

import torch

from splatmill_worker.kernels.records import Rates
from splatmill_worker.splat.engine.open import gaussians_of
from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.plan.facts import Speed
from splatmill_worker.splat.views import Target, TrainingView

ZERO_RATES = Rates(means=0.0, log_scales=0.0, quats=0.0, logit_opacities=0.0, sh_dc=0.0, sh_rest=0.0)
"""Steps with these rates change no parameter."""

GROWN = 32_768
"""Gaussians of the scene that is timed: a step on the few Gaussians of the start is mostly fixed costs, and their
large ellipses overlap unlike those of a trained scene (decisions: forecast)."""

GROWN_OPACITY = 0.3
"""Opacity of the Gaussians of the scene that is timed; that of the start, 0.1, makes lists longer than in training."""

PHOTOS = 4
"""Photos that are timed, evenly chosen, while LONGEST has time for them."""

LONGEST = 2.0
"""Seconds after which no further photo is timed: where steps take long, as those of the reference or on large photos,
noise is a small part of them."""

REPEATS = 2
"""Steps per photo and size after the first one, which also warms up; the fastest of all counts."""

SMALL = 4
"""Reduction of the photos of the second measurement."""


def probe(engine: Engine, views: Sequence[TrainingView], *, most: int = GROWN) -> Speed:
    """The time of a training step, divided into a part per pixel and a part per Gaussian.

    engine: holds the first Gaussians. Its parameters are the same afterwards.
    most: number of Gaussians that the photos resolve; a scene is not timed with more, unless it starts with more. 0: it
        is timed as it is, as a model that is trained already.

    What is timed is a scene that has grown from the first Gaussians, as training makes it (`grown`). Two sizes of the
    same photos are timed: the difference is the pixels' part, the rest is the Gaussians'. The fastest of a few steps
    counts, since other programs can only add to the time.
    """
    parameters = engine.parameters()
    engine.replace(grown(gaussians_of(engine), min(GROWN, most)).parameters(), None, None)
    began = time.perf_counter()
    timed: list[tuple[float, float, float, float]] = []
    for at in range(PHOTOS):
        view = views[(2 * at + 1) * len(views) // (2 * PHOTOS)]
        full, small = view.full, view.reduced(SMALL)
        timed.append((_seconds(engine, full), _seconds(engine, small), _pixels(full), _pixels(small)))
        view.forget_reduced()
        if time.perf_counter() - began > LONGEST:
            break
    count = engine.count
    engine.replace(parameters, None, None)
    slow, fast, pixels, small_pixels = (sum(each) / len(timed) for each in zip(*timed, strict=True))
    # The lower bounds keep both parts positive when the noise of the timing exceeds their difference.
    per_pixel = max(slow - fast, 1e-3 * slow) / max(1.0, pixels - small_pixels)
    per_gaussian = max(fast - per_pixel * small_pixels, 0.05 * fast) / max(1, count)
    return Speed(per_pixel, per_gaussian)


def grown(first: Gaussians, count: int) -> Gaussians:
    """`count` Gaussians that cover what `first` cover: copies, equally many of each but for one, scattered by their own
    size and smaller by the root of their number. `first` itself, of degree 3, where it has as many already.
    """
    whole = first.padded(3)
    if not 0 < first.count < count:
        return whole
    dice = torch.Generator().manual_seed(0)
    original = torch.arange(count) * first.count // count
    many = whole.map(lambda value: value[original.to(value.device)])
    scatter = torch.randn(many.means.shape, generator=dice).to(many.means)
    many.means.add_(scatter * many.log_scales.exp())
    many.log_scales.sub_(0.5 * math.log(count / first.count))
    many.logit_opacities.fill_(math.log(GROWN_OPACITY / (1.0 - GROWN_OPACITY)))
    return many


def _pixels(target: Target) -> float:
    return target.camera.width * target.camera.height


def _seconds(engine: Engine, target: Target) -> float:
    best = float("inf")
    for step in range(1, REPEATS + 2):
        started = time.perf_counter()
        engine.train_photo(
            target.viewmat, target.K, target.rgb, degree=3, rates=ZERO_RATES, step=step, mask=target.mask
        )
        if torch.cuda.is_available():
            torch.cuda.synchronize()  # a GPU's step is only enqueued
        best = min(best, time.perf_counter() - started)
    return best
