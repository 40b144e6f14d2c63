"""Launch settings that the autotuner chooses from.

It measures once per kernel, GPU and magnitude of the lists, and keeps the result on disk.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import triton

from ..device import interpreting

# One setting for the passes that are bound by memory; several for those that walk the lists.
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


def magnitude(pairs: int) -> int:
    """Return the power of 16 that the length of a view's lists reaches: settings are measured anew for each.

    What is fastest on the few pairs of a thumbnail is not so on millions. Both kernels that walk the lists take this
    number for the autotuner alone.
    """
    return (max(pairs, 1).bit_length() - 1) // 4


def autotune(
    configs: Sequence[triton.Config],
    key: Sequence[str],
    *,
    reset: Sequence[str] = (),
) -> Callable[[Any], Any]:
    """Return Triton's autotuner with results on disk; `key` names the arguments that a result depends on.

    reset: arrays that the kernel adds to (they may be None), set to 0 before each trial and before the launch itself;
    what such an array holds before the launch is lost. Under the interpreter the first setting is taken, since times
    mean nothing there.
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
