"""The caller's callbacks: reports of progress, and requests to cancel, which also reach COLMAP's native calls."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import TypeVar

from splatmill_worker.colmap import pycolmap
from splatmill_worker.errors import Cancelled

Result = TypeVar("Result")

OnProgress = Callable[[str, int, int, str], None]
"""Called as (stage, done, total, note); the note names the file or the things that are counted."""

POLL_SECONDS = 0.1
"""Seconds between two calls of `cancelled` while native code runs."""


def watched(
    call: Callable[[pycolmap.CancellationToken], Result],
    cancelled: Callable[[], bool],
    observe: Callable[[], None] = lambda: None,
) -> Result:
    """Run native code in a thread of its own, and call `observe` in this one about every POLL_SECONDS.

    call: is given a token that is cancelled when `cancelled()` turns true, or when `observe` raises. While native code
        holds Python's lock, as COLMAP's bundle adjustment does, neither is called.

    Raises Cancelled at the end of the call when `cancelled()` is true, and what `call` and `observe` raise.
    """
    token = pycolmap.CancellationToken()
    with ThreadPoolExecutor(1, thread_name_prefix="sfm") as thread:
        running = thread.submit(call, token)
        try:
            while not wait([running], POLL_SECONDS).done:
                observe()
                if cancelled():
                    token.cancel()
        except BaseException:
            token.cancel()
            raise
    stop_if(cancelled)
    return running.result()


def stop_if(cancelled: Callable[[], bool]) -> None:
    """Raise Cancelled when the caller has asked to stop."""
    if cancelled():
        raise Cancelled("Recovering the cameras was cancelled.")
