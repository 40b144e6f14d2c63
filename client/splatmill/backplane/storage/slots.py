"""A bounded number of threads that wait for one backend, so that a backend that stalls leaves the others free."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager


class NoSlot(Exception):
    """All slots are taken by operations that have not ended for a while."""


class Slots:
    """Lets `count` operations run at a time.

    patience: seconds that an operation waits for a slot. Once one has waited in vain, the next ones do not wait until
    an operation ends: a backend that stalls would otherwise hold each of them for this long.
    """

    def __init__(self, count: int, patience: float) -> None:
        self.count = count
        self._free = count
        self._patience = patience
        self._stalled = False
        self._changed = threading.Condition()

    @contextmanager
    def taken(self) -> Iterator[None]:
        """Hold a slot while the context is open. Raises NoSlot."""
        with self._changed:
            deadline = time.monotonic() + self._patience
            while not self._free:
                left = deadline - time.monotonic()
                if self._stalled or left <= 0:
                    self._stalled = True
                    self._changed.notify_all()
                    raise NoSlot
                self._changed.wait(left)
            self._free -= 1
        try:
            yield
        finally:
            with self._changed:
                self._free += 1
                self._stalled = False
                self._changed.notify()
