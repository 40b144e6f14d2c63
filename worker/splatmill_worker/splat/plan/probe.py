"""How fast this machine trains this scene: a few steps that change nothing."""

from __future__ import annotations

import time
from collections.abc import Sequence

import torch

from splatmill_worker.kernels.records import Rates
from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.plan.facts import Speed
from splatmill_worker.splat.views import Target, TrainingView

ZERO_RATES = Rates(means=0.0, log_scales=0.0, quats=0.0, logit_opacities=0.0, sh_dc=0.0, sh_rest=0.0)
REPEATS = 3
SMALL = 4


def probe(engine: Engine, views: Sequence[TrainingView]) -> Speed:
    """Time steps with zero rates at full size and at a quarter of it; the engine is left as it was.

    The small photo's time is mostly the Gaussians' part, the difference is the pixels'. The fastest of a few
    is taken: what else runs on the machine can only add.
    """
    middle = views[len(views) // 2]
    small, full = middle.reduced(SMALL), middle.full
    parameters = engine.parameters()
    fast, slow = _seconds(engine, small), _seconds(engine, full)
    engine.replace(parameters, None, None)
    pixels = full.camera.width * full.camera.height
    fewer = small.camera.width * small.camera.height
    per_pixel = max(slow - fast, 1e-3 * slow) / max(1, pixels - fewer)
    per_gaussian = max(fast - per_pixel * fewer, 0.05 * fast) / max(1, engine.count)
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
