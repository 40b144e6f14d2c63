"""The lists of (tile, Gaussian) pairs take memory by their total, and too many of them are a named error.

Not proven here: which pairs there are (test_proof_forward), and that training recovers (test_train).
"""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.cpu import isa
from splatmill_worker.kernels.cpu.step import Step
from splatmill_worker.kernels.records import TILE, Projected, TooManyPairs
from tests.support.kernels.proof import use

SIDE = 256
"""Width and height of the image in pixels: 256 tiles."""


def one_in(threads: int, count: int, *parts: int) -> Step:
    """`count` Gaussians in front of the camera, the ones of these threads' parts as large as the image."""
    means = torch.randn(count, 3, generator=torch.Generator().manual_seed(1)) * 0.5
    means[:, 2] = 4.0 + torch.rand(count, generator=torch.Generator().manual_seed(2))
    log_scales = torch.full((count, 3), math.log(1e-3))
    for part in parts:
        log_scales[count * part // threads : count * (part + 1) // threads] = math.log(3.0)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1)
    logits, sh = torch.full((count,), -2.0), torch.zeros(count, 16, 3)
    return Step(means, log_scales, quats, logits, sh, threads=threads)


def view(step: Step, away: float = 0.0) -> Tensor:
    viewmat = torch.eye(4)
    viewmat[0, 3] = away
    K = torch.tensor([[200.0, 0.0, SIDE / 2], [0.0, 200.0, SIDE / 2], [0.0, 0.0, 1.0]])
    return step.forward(viewmat, K, SIDE, SIDE, degree=0)[0].clone()


def bound(step: Step, pairs: int, threads: int) -> int:
    """Slots for views of at most `pairs`: 2.5 times as many, the least that each thread has, and the buffer's half."""
    return int(1.5 * (2.5 * pairs + 2 * step.count + 4096 * threads))


def test_memory_for_pairs_follows_their_total_and_not_the_busiest_thread() -> None:
    threads, count = 16, 4096
    step = one_in(threads, count, 9)
    image = view(step)
    pairs = step.visibility.pairs
    assert pairs > count // threads * 200, "one thread's Gaussians cover nearly all tiles"
    slots = step._frame.slots
    assert slots <= bound(step, pairs, threads)
    assert slots < threads * pairs / 4
    alone = one_in(threads, count, 9)
    alone.threads = 1
    assert torch.equal(image, view(alone))


def test_views_that_are_busy_in_different_threads_share_their_room() -> None:
    """Every thread has a view of its own in which it is the busiest; without sharing, there is room for all at once."""
    threads, count = 16, 4096
    step = one_in(threads, count)
    most, scales = 0, step.parameters()["log_scales"]
    for part in range(threads):
        large = scales.clone()
        large[count * part // threads : count * (part + 1) // threads] = math.log(3.0)
        step.replace({**step.parameters(), "log_scales": large}, None, None)
        view(step)
        most = max(most, step.visibility.pairs)
    assert most > count // threads * 200
    assert step._frame.slots <= bound(step, most, threads)


@pytest.mark.parametrize("build", isa.supported())
def test_too_many_pairs_are_a_named_error_before_memory_is_taken(build: str) -> None:
    side, count = 32768, 600
    each = (side // TILE) ** 2
    assert each * count > 2**31
    ones = torch.ones(count)
    huge = Projected(
        means2d=torch.full((count, 2), side / 2),
        conics=torch.tensor([1e-10, 0.0, 1e-10]).repeat(count, 1),
        opacities=0.5 * ones, colors=torch.ones(count, 3), depths=ones,
        extents=torch.full((count, 2), 4.0 * side),
    )  # fmt: skip
    with use(f"cpu:{build}") as op:
        with pytest.raises(
            TooManyPairs, match=rf"about {each * count} tiles.*hold 2147483647.*fewer Gaussians"
        ):
            ops.bin(huge, side, side, backend=op)
        few = Projected(*(field[:2] for field in huge))
        assert int(ops.bin(few, 64, 64, backend=op).offsets[-1]) == 2 * 16
    assert issubclass(TooManyPairs, MemoryError), "training recovers from it as from a failed allocation"
