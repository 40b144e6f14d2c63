"""Adam for the visible Gaussians; one that becomes visible again first makes up for the steps it missed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import accumulate
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from ..records import BETA1, EPS, GROUPS
from ..reference.adam import MEMORY
from .launch.argument import Bytes, Float, Floats, Int, Ints
from .launch.constant import LARGEST, constant
from .transfers.transfer import to_device

B1, EPSILON = constant(BETA1), constant(EPS)
LOG2_B1 = constant(math.log2(BETA1))
LONGEST = constant(MEMORY)
BLOCK = 256
"""Gaussians per program."""

# Where the groups end among the 59 planes; the SH coefficients of degree 0 have a rate of their own.
_ENDS = list(accumulate(GROUPS.values()))
MEANS, SCALES, QUATS, OPACITY = (constant(end) for end in _ENDS[:4])
DC = constant(_ENDS[3] + 3)


@lru_cache(maxsize=4)
def correction(room: int, where: torch.device, beta2: float) -> Tensor:
    """Return sqrt(1 - beta2^s) / (1 - beta1^s) for s = 0 .. room - 1 (0 at 0) as float32.

    Computed in float64, because 1 - 0.999 has few significant digits in float32.
    """
    s = torch.arange(1, room, dtype=torch.float64)
    values = torch.sqrt(1 - beta2**s) / (1 - BETA1**s)
    return to_device(torch.cat([torch.zeros(1, dtype=torch.float64), values]).float(), where)


@triton.jit
def drift_kernel(
    last_step: Ints, visible: Bytes, table: Floats, travel: Floats, decay1: Floats, decay2: Floats, count: Int,
    step: Int, ratio: Float, log2_beta2: Float, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write what the steps that each Gaussian missed before `step` amount to, and mark every seen one as current.

    travel is `reference.adam.drift` in units of rate * m / sqrt(v): the sum over the missed steps s = last + j of
    ratio^j * correction(s), where ratio is beta1 / sqrt(beta2). decay1 and decay2 are the factors on the two moments.
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = i < count
    shown = here & (tl.load(visible + i, mask=here, other=0) != 0)
    last = tl.load(last_step + i, mask=here, other=0)
    missed = tl.where(shown, tl.maximum(step - 1 - last, 0), 0)
    most = tl.minimum(tl.max(missed, 0), LONGEST)
    total = tl.zeros([BLOCK], tl.float32)
    power = tl.zeros([BLOCK], tl.float32) + 1.0
    j = 1
    while j <= most:
        power = power * ratio
        term = tl.load(table + last + j, mask=shown & (j <= missed), other=0.0)
        total += power * term
        j += 1
    tl.store(travel + i, total, mask=here)
    tl.store(decay1 + i, tl.exp2(LOG2_B1 * missed), mask=here)
    tl.store(decay2 + i, tl.exp2(log2_beta2 * missed), mask=here)
    tl.store(last_step + i, tl.where(shown, step, last), mask=here)


@triton.jit
def advance(p, g, m, v, rate, size, root, keep, add):
    """Adam's arithmetic; the last four are 1 / (1 - beta1^step), 1 / sqrt(1 - beta2^step), beta2 and 1 - beta2."""
    good = g * g <= LARGEST
    g = tl.where(good, g, 0.0)
    m_new = B1 * m + (1.0 - B1) * g
    v_new = keep * v + add * g * g
    moved = p - rate * size * m_new / (root * tl.sqrt_rn(v_new) + EPSILON)
    return tl.where(good, moved, p), tl.where(good, m_new, m), tl.where(good, v_new, v), ~good


@triton.jit
def planes_kernel(
    values: Floats, grads: Floats, exp_avg: Floats, exp_avg_sq: Floats, visible: Bytes, travel: Floats, decay1: Floats,
    decay2: Floats, refused: Ints, count: Int, stride: Int, channels: Int, means_rate: Float, scales_rate: Float,
    quats_rate: Float, opacity_rate: Float, dc_rate: Float, rest_rate: Float, size: Float, root: Float, keep: Float,
    add: Float, BLOCK: tl.constexpr,
):  # fmt: skip
    """One step on the first `channels` of a scene's planes [59, stride], for the Gaussians seen."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = i < count
    shown = here & (tl.load(visible + i, mask=here, other=0) != 0)
    gone = tl.load(travel + i, mask=shown, other=0.0)
    keep1 = tl.load(decay1 + i, mask=shown, other=1.0)
    keep2 = tl.load(decay2 + i, mask=shown, other=1.0)
    number = tl.zeros([BLOCK], tl.int32)
    for channel in tl.range(0, channels):
        rate = tl.where(channel < MEANS, means_rate, tl.where(channel < SCALES, scales_rate, quats_rate))
        late = tl.where(channel < OPACITY, opacity_rate, tl.where(channel < DC, dc_rate, rest_rate))
        rate = tl.where(channel < QUATS, rate, late)
        place = channel * stride + i
        p = tl.load(values + place, mask=shown, other=0.0)
        g = tl.load(grads + place, mask=shown, other=0.0)
        m = tl.load(exp_avg + place, mask=shown, other=0.0)
        v = tl.load(exp_avg_sq + place, mask=shown, other=0.0)
        p -= rate * gone * tl.where(v > 0.0, m / tl.sqrt_rn(v), 0.0)
        p, m, v, bad = advance(p, g, m * keep1, v * keep2, rate, size, root, keep, add)
        tl.store(values + place, p, mask=shown)
        tl.store(exp_avg + place, m, mask=shown)
        tl.store(exp_avg_sq + place, v, mask=shown)
        number += (bad & shown).to(tl.int32)
    total = tl.sum(number, axis=0)
    if total > 0:
        tl.atomic_add(refused, total)


class CatchUp:
    """What the visible Gaussians of one step missed, as `drift_kernel` computes it, for use by every group.

    Marks the rows of visible (uint8 [N]) as current in last_step (int32 [N]).
    """

    def __init__(self, visible: Tensor, last_step: Tensor, step: int, beta2: float) -> None:
        count = visible.shape[0]
        like: dict[str, Any] = {"device": visible.device, "dtype": torch.float32}
        self.visible = visible
        self.travel, self.decay1, self.decay2 = (torch.empty(count, **like) for _ in range(3))
        table = correction(
            max(1024, 1 << step.bit_length()), visible.device, beta2
        )  # a new table per doubling
        if count:
            drift_kernel[(triton.cdiv(count, BLOCK),)](
                last_step, visible, table, self.travel, self.decay1, self.decay2, count, step,
                BETA1 / math.sqrt(beta2), math.log2(beta2), BLOCK=BLOCK,
            )  # fmt: skip


def _scale(step: int, beta2: float) -> tuple[float, float, float, float]:
    """What `advance` needs of a step: size, root, keep and add."""
    return 1 / (1 - BETA1**step), 1 / math.sqrt(1 - beta2**step), beta2, 1 - beta2


def apply_planes(
    params: Tensor, grads: Tensor, exp_avg: Tensor, exp_avg_sq: Tensor, rates: Sequence[float],
    channels: int, step: int, beta2: float, refused: Tensor, missed: CatchUp,
) -> None:  # fmt: skip
    """One step in place on the first `channels` of planes [59, N]; six rates, in the order of `Rates`."""
    count = params.shape[1]
    if count:
        planes_kernel[(triton.cdiv(count, BLOCK),)](
            params, grads, exp_avg, exp_avg_sq, missed.visible, missed.travel, missed.decay1, missed.decay2, refused,
            count, count, channels, *rates, *_scale(step, beta2), BLOCK=BLOCK,
        )  # fmt: skip
