"""Launch settings: what the autotuner may choose from, measured once per kernel and card and kept in Triton's cache on disk."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import triton

from .device import interpreting

PROJECT = [triton.Config({"BLOCK": block}, num_warps=warps) for block, warps in ((128, 4), (64, 2))]
PROJECT_BACKWARD = [triton.Config({"BLOCK": block}, num_warps=warps) for block, warps in ((64, 2), (128, 4))]
COMPOSITE = [
    triton.Config({"BATCH": batch}, num_warps=warps, num_stages=1)
    for batch, warps in ((2, 2), (4, 2), (4, 1), (8, 2))
]
COMPOSITE_BACKWARD = [
    triton.Config({"BATCH": batch}, num_warps=warps, num_stages=1)
    for batch, warps in ((2, 1), (2, 2), (1, 2))
]
SMALLEST_LOSS_BLOCK = 128
LOSS = [triton.Config({"BLOCK": block}, num_warps=block // 64) for block in (256, 128)]


def autotune(
    configs: Sequence[triton.Config],
    key: Sequence[str],
    *,
    reset: Sequence[str] = (),
    keep: Sequence[str] = (),
) -> Callable[[Any], Any]:
    """Triton's autotuner with its results on disk; `reset` names accumulators (or None) to zero between trials.

    Under the interpreter timing means nothing, and the first setting is taken. `reset` must not name an array whose contents
    before the launch matter: the tuner zeroes it also before the launch that counts. `keep` names arrays that the kernel changes
    and reads, which every trial must find as they were.
    """

    kept: dict[str, Any] = {}

    def before(arguments: Mapping[str, Any], reset_only: bool = False) -> None:
        for name in reset:
            if arguments[name] is not None:
                arguments[name].zero_()
        if not reset_only:
            kept.update((name, arguments[name].clone()) for name in keep)

    def after(arguments: Mapping[str, Any], exception: Exception | None) -> None:
        while kept:
            name, value = kept.popitem()
            arguments[name].copy_(value)

    choices = [configs[0]] if interpreting() else list(configs)
    return triton.autotune(
        configs=choices, key=list(key), pre_hook=before, post_hook=after, cache_results=True
    )
