"""How fast this machine trains this scene, measured by a few steps with learning rates of zero."""

from __future__ import annotations

import time
from collections.abc import Sequence

import torch

from splatmill_worker.kernels.records import Rates
from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.plan.facts import Speed
from splatmill_worker.splat.views import Target, TrainingView

ZERO_RATES = Rates(means=0.0, log_scales=0.0, quats=0.0, logit_opacities=0.0, sh_dc=0.0, sh_rest=0.0)
"""Steps with these rates change no parameter."""

REPEATS = 3
"""Steps per size after the first one, which also warms up; the fastest of all counts."""

SMALL = 4
"""Reduction of the photo of the second measurement."""


def probe(engine: Engine, views: Sequence[TrainingView]) -> Speed:
    """The time of a training step, divided into a part per pixel and a part per Gaussian.

    The parameters of the engine are the same afterwards.

    Two sizes of the same photo are timed: the difference is the pixels' part, the rest is the Gaussians'. The
    fastest of a few steps counts, since other programs can only add to the time.
    """
    view = views[len(views) // 2]
    small, full = view.reduced(SMALL), view.full
    parameters = engine.parameters()
    fast, slow = _seconds(engine, small), _seconds(engine, full)
    engine.replace(parameters, None, None)
    pixels = full.camera.width * full.camera.height
    small_pixels = small.camera.width * small.camera.height
    # The lower bounds keep both parts positive when the noise of the timing exceeds their difference.
    per_pixel = max(slow - fast, 1e-3 * slow) / max(1, pixels - small_pixels)
    per_gaussian = max(fast - per_pixel * small_pixels, 0.05 * fast) / max(1, engine.count)
    return Speed(per_pixel, per_gaussian)


def _seconds(engine: Engine, target: Target) -> float:
    best = float("inf")
    for step in range(1, REPEATS + 2):
        started = time.perf_counter()
        engine.train_photo(
            target.viewmat, target.K, target.rgb, degree=0, rates=ZERO_RATES, step=step, mask=target.mask
        )
        if torch.cuda.is_available():
            torch.cuda.synchronize()  # a GPU's step is only enqueued
        best = min(best, time.perf_counter() - started)
    return best
