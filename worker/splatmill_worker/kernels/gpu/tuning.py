"""Launch settings: what the autotuner may choose from, measured once per kernel and card and kept in
Triton's cache on disk.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import triton

from .device import interpreting

# Passes that memory bounds gain nothing from a choice; the walks through the lists do.
PROJECT = [triton.Config({"BLOCK": 128}, num_warps=4)]
PROJECT_BACKWARD = [triton.Config({"BLOCK": 64}, num_warps=2)]
LOSS = [triton.Config({"BLOCK": 256}, num_warps=4)]
SMALLEST_LOSS_BLOCK = 256
COMPOSITE = [
    triton.Config({"BATCH": batch}, num_warps=warps, num_stages=1)
    for batch, warps in ((2, 2), (4, 2), (4, 1), (8, 2))
]
COMPOSITE_BACKWARD = [
    triton.Config({"BATCH": batch}, num_warps=warps, num_stages=1)
    for batch, warps in ((2, 1), (2, 2), (1, 2))
]


def autotune(
    configs: Sequence[triton.Config],
    key: Sequence[str],
    *,
    reset: Sequence[str] = (),
) -> Callable[[Any], Any]:
    """Triton's autotuner with its results on disk; `reset` names accumulators (or None) to zero between
    trials.

    Under the interpreter timing means nothing, and the first setting is taken. `reset` must not name an array
    whose contents before the launch matter: the tuner zeroes it also before the launch that counts.
    """

    def before(arguments: Mapping[str, Any], reset_only: bool = False) -> None:
        for name in reset:
            if arguments[name] is not None:
                arguments[name].zero_()

    choices = [configs[0]] if interpreting() else list(configs)
    tuner: Callable[[Any], Any] = triton.autotune(
        configs=choices, key=list(key), pre_hook=before, cache_results=True
    )
    return tuner
