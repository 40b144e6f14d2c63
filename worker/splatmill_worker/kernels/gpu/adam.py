"""Adam for the Gaussians that were seen, with the steps that a Gaussian missed made up when it is seen
again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from ..reference.adam import BETA1, BETA2, EPS, MEMORY
from . import device
from .constant import constant

B1, B2, EPSILON = constant(BETA1), constant(BETA2), constant(EPS)
LOG2_B1, LOG2_B2 = constant(math.log2(BETA1)), constant(math.log2(BETA2))
RATIO = constant(BETA1 / math.sqrt(BETA2))
LONGEST = constant(MEMORY)
BLOCK = 256


@lru_cache(maxsize=4)
def correction(room: int, where: torch.device) -> Tensor:
    """sqrt(1 - beta2^s) / (1 - beta1^s) for s = 0 .. room - 1 (0 at 0), from float64: 1 - 0.999 has few
    digits in float32.
    """
    s = torch.arange(1, room, dtype=torch.float64)
    values = torch.sqrt(1 - BETA2**s) / (1 - BETA1**s)
    return torch.cat([torch.zeros(1, dtype=torch.float64), values]).to(where, torch.float32)


@triton.jit
def drift_kernel(last_step, seen, table, travel, decay1, decay2, count, step, BLOCK: tl.constexpr):
    """Per Gaussian what the steps it missed before `step` amount to: travel in units of rate * m / sqrt(v),
    and both decays.

    Marks every seen one as current. travel is `reference.adam.drift`: the sum over missed steps s = last + j
    of (beta1 / sqrt(beta2))^j * correction(s).
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = i < count
    shown = here & (tl.load(seen + i, mask=here, other=0) != 0)
    last = tl.load(last_step + i, mask=here, other=0)
    missed = tl.where(shown, tl.maximum(step - 1 - last, 0), 0)
    most = tl.minimum(tl.max(missed, 0), LONGEST)
    total = tl.zeros([BLOCK], tl.float32)
    power = tl.zeros([BLOCK], tl.float32) + 1.0
    j = 1
    while j <= most:
        power = power * RATIO
        term = tl.load(table + last + j, mask=shown & (j <= missed), other=0.0)
        total += power * term
        j += 1
    tl.store(travel + i, total, mask=here)
    tl.store(decay1 + i, tl.exp2(LOG2_B1 * missed), mask=here)
    tl.store(decay2 + i, tl.exp2(LOG2_B2 * missed), mask=here)
    tl.store(last_step + i, tl.where(shown, step, last), mask=here)


@triton.jit
def adam_kernel(
    params, grads, exp_avg, exp_avg_sq, seen, travel, decay1, decay2, refused, count, rate, size, root,
    CHANNELS: tl.constexpr, VISIBLE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """One step on [N, CHANNELS] rows. An entry whose gradient or its square is not finite stays as it was
    and is counted.
    """
    e = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    shown = e < count * CHANNELS
    i = e // CHANNELS
    if VISIBLE:
        shown = shown & (tl.load(seen + i, mask=shown, other=0) != 0)
    p = tl.load(params + e, mask=shown, other=0.0)
    g = tl.load(grads + e, mask=shown, other=0.0)
    m = tl.load(exp_avg + e, mask=shown, other=0.0)
    v = tl.load(exp_avg_sq + e, mask=shown, other=0.0)
    if VISIBLE:
        gone = tl.load(travel + i, mask=shown, other=0.0)
        p -= rate * gone * tl.where(v > 0.0, m / tl.sqrt_rn(v), 0.0)
        m *= tl.load(decay1 + i, mask=shown, other=1.0)
        v *= tl.load(decay2 + i, mask=shown, other=1.0)
    p, m, v, bad = advance(p, g, m, v, rate, size, root)
    tl.store(params + e, p, mask=shown)
    tl.store(exp_avg + e, m, mask=shown)
    tl.store(exp_avg_sq + e, v, mask=shown)
    number = tl.sum((bad & shown).to(tl.int32), axis=0)
    if number > 0:
        tl.atomic_add(refused, number)


@triton.jit
def advance(p, g, m, v, rate, size, root):
    """Adam's arithmetic: size = 1 / (1 - beta1^step), root = 1 / sqrt(1 - beta2^step)."""
    good = g * g <= 3.4028234e38
    g = tl.where(good, g, 0.0)
    m_new = B1 * m + (1.0 - B1) * g
    v_new = B2 * v + (1.0 - B2) * g * g
    moved = p - rate * size * m_new / (root * tl.sqrt_rn(v_new) + EPSILON)
    return tl.where(good, moved, p), tl.where(good, m_new, m), tl.where(good, v_new, v), ~good


@triton.jit
def planes_kernel(
    params, grads, exp_avg, exp_avg_sq, seen, travel, decay1, decay2, refused, count, stride, channels,
    means_rate, scales_rate, quats_rate, opacity_rate, dc_rate, rest_rate, size, root,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """One step on planes [59, stride] of a whole scene: 3 means, 3 log-scales, 4 quaternions, 1 opacity, 3
    + 45 SH.
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = i < count
    shown = here & (tl.load(seen + i, mask=here, other=0) != 0)
    gone = tl.load(travel + i, mask=shown, other=0.0)
    keep1 = tl.load(decay1 + i, mask=shown, other=1.0)
    keep2 = tl.load(decay2 + i, mask=shown, other=1.0)
    number = tl.zeros([BLOCK], tl.int32)
    for channel in tl.range(0, channels):
        rate = tl.where(channel < 3, means_rate, tl.where(channel < 6, scales_rate, quats_rate))
        late = tl.where(channel < 11, opacity_rate, tl.where(channel < 14, dc_rate, rest_rate))
        rate = tl.where(channel < 10, rate, late)
        place = channel * stride + i
        p = tl.load(params + place, mask=shown, other=0.0)
        g = tl.load(grads + place, mask=shown, other=0.0)
        m = tl.load(exp_avg + place, mask=shown, other=0.0)
        v = tl.load(exp_avg_sq + place, mask=shown, other=0.0)
        p -= rate * gone * tl.where(v > 0.0, m / tl.sqrt_rn(v), 0.0)
        p, m, v, bad = advance(p, g, m * keep1, v * keep2, rate, size, root)
        tl.store(params + place, p, mask=shown)
        tl.store(exp_avg + place, m, mask=shown)
        tl.store(exp_avg_sq + place, v, mask=shown)
        number += (bad & shown).to(tl.int32)
    total = tl.sum(number, axis=0)
    if total > 0:
        tl.atomic_add(refused, total)


class CatchUp:
    """Travel and decays [N] of one step's visible rows, made once and used by every group."""

    def __init__(self, seen: Tensor, last_step: Tensor, step: int) -> None:
        count = seen.shape[0]
        like: dict[str, Any] = {"device": seen.device, "dtype": torch.float32}
        self.seen = seen
        self.travel, self.decay1, self.decay2 = (torch.empty(count, **like) for _ in range(3))
        table = correction(max(1024, 1 << step.bit_length()), seen.device)  # a new table per doubling
        if count:
            drift_kernel[(triton.cdiv(count, BLOCK),)](
                last_step, seen, table, self.travel, self.decay1, self.decay2, count, step, BLOCK=BLOCK
            )


def apply(
    param: Tensor, grad: Tensor, exp_avg: Tensor, exp_avg_sq: Tensor, rate: float, step: int, refused: Tensor,
    missed: CatchUp | None,
) -> None:  # fmt: skip
    """One step of one contiguous group [N, ...] in place; refused (int32 [1]) counts entries that were
    left.
    """
    count = param.shape[0]
    entries = param.numel()
    if not entries:
        return
    size, root = 1 / (1 - BETA1**step), 1 / math.sqrt(1 - BETA2**step)
    late = (None,) * 4 if missed is None else (missed.seen, missed.travel, missed.decay1, missed.decay2)
    adam_kernel[(triton.cdiv(entries, 4 * BLOCK),)](
        param, grad.contiguous(), exp_avg, exp_avg_sq, *late, refused, count, rate, size, root,
        CHANNELS=entries // count, VISIBLE=missed is not None, BLOCK=4 * BLOCK,
    )  # fmt: skip


def apply_planes(
    params: Tensor, grads: Tensor, exp_avg: Tensor, exp_avg_sq: Tensor, rates: Sequence[float],
    channels: int, step: int, refused: Tensor, missed: CatchUp,
) -> None:  # fmt: skip
    """One step in place of the first `channels` of planes [59, N]; rates of means, log-scales, quats,
    opacity, SH DC and rest.
    """
    count = params.shape[1]
    size, root = 1 / (1 - BETA1**step), 1 / math.sqrt(1 - BETA2**step)
    if count:
        planes_kernel[(triton.cdiv(count, BLOCK),)](
            params, grads, exp_avg, exp_avg_sq, missed.seen, missed.travel, missed.decay1, missed.decay2, refused,
            count, count, channels, *rates, size, root, BLOCK=BLOCK,
        )  # fmt: skip


@torch.no_grad()
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
) -> int:
    """One Adam step in place as `reference.adam_` defines it; returns how many entries were refused, which
    waits once.
    """
    device.require(params[0])
    refused = torch.zeros(1, dtype=torch.int32, device=params[0].device)
    missed = None
    if visible is not None:
        if last_step is None:
            raise ValueError("last_step: needed with visible, to know how many steps a row missed")
        missed = CatchUp(visible.to(torch.uint8), last_step, step)
    for p, g, m, v, rate in zip(params, grads, exp_avg, exp_avg_sq, rates, strict=True):
        apply(p, g, m, v, rate, step, refused, missed)
    return int(refused)
