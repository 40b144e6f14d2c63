"""Numbers that steps measured, fetched while later steps run, so that no step waits for the device."""

from __future__ import annotations

from collections import deque

from torch import Tensor

from splatmill_worker.kernels.records import StepResult

from .transfer import ToHost

AHEAD = 8
"""Steps that the host may be ahead of the device. More would only make the numbers it reads older."""


class Readback:
    """A queue of copies that are on their way from the device."""

    def __init__(self) -> None:
        self._pending: deque[tuple[tuple[int, tuple[int, int, int]], ToHost]] = deque()
        self._latest: StepResult | None = None

    def post(
        self, key: tuple[int, tuple[int, int, int]], values: Tensor
    ) -> list[tuple[tuple[int, tuple[int, int, int]], StepResult]]:
        """Start the copy of values [6] float64, the fields of a `StepResult`; returns what has arrived since, by key.

        key: the generation of the parameters (see `Step.replace`), and the key of the view.

        Waits only when nothing has ever arrived, or when the host is `AHEAD` steps in front.
        """
        self._pending.append((key, ToHost(values)))
        results = []
        while self._pending:
            name, numbers = self._pending[0]
            if not numbers.arrived and self._latest is not None and len(self._pending) <= AHEAD:
                break
            loss, l1, ssim, visible, pairs, refused = numbers.wait()
            self._latest = StepResult(loss, l1, ssim, int(visible), int(pairs), int(refused))
            results.append((name, self._latest))
            self._pending.popleft()
        return results

    @property
    def latest(self) -> StepResult:
        """The numbers of the most recent step that has arrived."""
        if self._latest is None:
            raise RuntimeError("No step has been posted yet.")
        return self._latest
