"""Ending tasks. One cancellation of a task may be lost, and whoever waits for its end would then wait for ever."""

import asyncio
from typing import Any

from anyio import CancelScope

_AGAIN_SECONDS = 2.0
"""Seconds after which a task that still runs is cancelled again; what tasks do at their end takes less, as a rule."""


async def end(*tasks: asyncio.Future[Any]) -> None:
    """Cancel tasks and wait until they have ended, also where the caller is cancelled meanwhile: that comes afterwards.
    What the tasks return or raise is dropped.

    A task that still runs is cancelled again: `asyncio.wait_for`, of which libraries make use, returns the result and
    loses the cancellation if both come in the same turn of the event loop (CPython before 3.12).
    """
    cancelled: asyncio.CancelledError | None = None
    clock, again = asyncio.get_running_loop().time, 0.0
    # A scope of anyio, as that of a response whose client has left, cancels at each turn of the event loop.
    with CancelScope(shield=True):
        while running := [task for task in tasks if not task.done()]:
            if clock() >= again:
                for task in running:
                    task.cancel()
                again = clock() + _AGAIN_SECONDS
            try:
                await asyncio.wait(running, timeout=again - clock())
            except asyncio.CancelledError as error:
                cancelled = error
    for task in tasks:
        if not task.cancelled():
            task.exception()  # otherwise asyncio reports it as not retrieved
    if cancelled is not None:
        raise cancelled
