"""The caller's callbacks: reports of progress, and requests to cancel, which also reach COLMAP's native calls."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from splatmill_worker.colmap import pycolmap
from splatmill_worker.errors import Cancelled

OnProgress = Callable[[str, int, int, str], None]
"""Called as (stage, done, total, note); the note names the file or the things that are counted."""

POLL_SECONDS = 0.1
"""Seconds between two calls of `cancelled` while native code runs."""


@contextmanager
def native_token(cancelled: Callable[[], bool]) -> Iterator[pycolmap.CancellationToken]:
    """Yield a token that is cancelled within POLL_SECONDS of `cancelled()` turning true.

    Raises Cancelled at the end of the block when `cancelled()` is true.
    """
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
    """Raise Cancelled when the caller has asked to stop."""
    if cancelled():
        raise Cancelled("Recovering the cameras was cancelled.")
