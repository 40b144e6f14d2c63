"""Copies between the host and the device that nobody waits for, unless told to."""

from __future__ import annotations

import torch
from torch import Tensor


def to_device(tensor: Tensor, where: torch.device) -> Tensor:
    """Return the tensor on a device, itself where it is there already.

    From the host the copy goes through pinned memory: from any other, it would wait for all that is enqueued.
    """
    if tensor.device == where:
        return tensor
    if tensor.device.type == "cpu" and where.type == "cuda":
        return tensor.contiguous().pin_memory().to(where, non_blocking=True)
    return tensor.to(where)


class ToHost:
    """A copy of a small tensor to pinned memory, enqueued where it is made, with the event that marks its arrival."""

    def __init__(self, values: Tensor) -> None:
        self._arrival: torch.cuda.Event | None = None
        if values.is_cuda:
            self._values = torch.empty(values.shape, dtype=values.dtype, pin_memory=True)
            self._values.copy_(values, non_blocking=True)
            self._arrival = torch.cuda.Event()
            self._arrival.record()
        else:
            self._values = values.clone()

    @property
    def arrived(self) -> bool:
        """Whether `wait` would return at once."""
        return self._arrival is None or self._arrival.query()

    def wait(self) -> list[float]:
        """Return the values, after waiting for the device to reach the copy."""
        if self._arrival is not None:
            self._arrival.synchronize()
        numbers: list[float] = self._values.tolist()
        return numbers
