"""Numbers of past steps, fetched while later ones run, so that no step waits for the device."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import torch
from torch import Tensor

AHEAD = 8
"""Steps that the host may be ahead of the device; more would only make what it reads older."""


class Numbers(NamedTuple):
    """What one step measured. `key` says of which parameters and view: a generation, and the view's own
    key.
    """

    key: tuple[int, tuple[int, int, int]]
    loss: float
    l1: float
    ssim: float
    visible: int
    pairs: int
    refused: int


class Readback:
    """A queue of small copies to pinned memory, each with the event that says it has arrived.

    steady: numbers come exactly `AHEAD` steps late, so that processes that compare notes read the same ones.
    """

    def __init__(self, *, steady: bool = False) -> None:
        self._steady = steady
        self._pending: deque[tuple[tuple[int, tuple[int, int, int]], Tensor, torch.cuda.Event | None]] = (
            deque()
        )
        self._latest: Numbers | None = None

    def post(self, key: tuple[int, tuple[int, int, int]], values: Tensor) -> list[Numbers]:
        """Send values [6] (loss, L1, SSIM, visible, pairs, refused; float64) on their way; returns all that
        has arrived since.

        Waits only when nothing has ever arrived, or the host is `AHEAD` steps in front.
        """
        if values.is_cuda:
            here = torch.empty(values.shape, dtype=values.dtype, pin_memory=True)
            here.copy_(values, non_blocking=True)
            arrived = torch.cuda.Event()
            arrived.record()
            self._pending.append((key, here, arrived))
        else:
            self._pending.append((key, values.clone(), None))
        found = []
        while self._pending:
            name, numbers, event = self._pending[0]
            early = self._steady or (event is not None and not event.query())
            if early and self._latest is not None and len(self._pending) <= AHEAD:
                break
            if event is not None:
                event.synchronize()
            loss, l1, ssim, visible, pairs, refused = numbers.tolist()
            self._latest = Numbers(name, loss, l1, ssim, int(visible), int(pairs), int(refused))
            found.append(self._latest)
            self._pending.popleft()
        return found

    @property
    def latest(self) -> Numbers:
        """Of the most recent step that has been heard from."""
        if self._latest is None:
            raise RuntimeError("no step has been posted yet")
        return self._latest
