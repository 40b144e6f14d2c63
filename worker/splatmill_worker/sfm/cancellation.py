"""Carries a caller's wish to stop into COLMAP's native calls."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from splatmill_worker.colmap import pycolmap
from splatmill_worker.errors import Cancelled

POLL_SECONDS = 0.1


@contextmanager
def native_token(cancelled: Callable[[], bool]) -> Iterator[pycolmap.CancellationToken]:
    """A token that is cancelled within 0.1 s of `cancelled()` turning true; raises Cancelled on the way out."""
    token = pycolmap.CancellationToken()
    over = threading.Event()

    def watch() -> None:
        while not over.wait(POLL_SECONDS):
            if cancelled():
                token.cancel()
                return

    watcher = threading.Thread(target=watch, name="sfm-cancel", daemon=True)
    watcher.start()
    try:
        yield token
    finally:
        over.set()
        watcher.join()
    stop_if(cancelled)


def stop_if(cancelled: Callable[[], bool]) -> None:
    """Raises Cancelled where the caller asked to stop."""
    if cancelled():
        raise Cancelled("Recovering the cameras was cancelled.")
