"""adam_ on the CPU: all parameter groups in one parallel pass."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from splatmill_worker.kernels import cpu
from splatmill_worker.kernels.records import BETA2


def adam_(
    params: Sequence[Tensor],
    grads: Sequence[Tensor],
    exp_avg: Sequence[Tensor],
    exp_avg_sq: Sequence[Tensor],
    rates: Sequence[float],
    *,
    step: int,
    visible: Tensor | None = None,
    last_step: Tensor | None = None,
    beta2: float = BETA2,
) -> int:
    """Take one Adam step in place, as `reference.adam_` defines it, on contiguous float32 tensors."""

    def rows(tensors: Sequence[Tensor]) -> list[Tensor]:
        return [t.detach().unsqueeze(1).flatten(1) for t in tensors]

    refused: int = cpu.engine.adam(
        rows(params),
        rows(grads),
        rows(exp_avg),
        rows(exp_avg_sq),
        list(rates),
        step,
        visible,
        last_step,
        beta2,
    )
    return refused
