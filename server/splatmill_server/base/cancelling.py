"""Ending tasks. One cancellation of a task may be lost, and who waits for the task's end then waits for ever."""

import asyncio
from typing import Any

_AGAIN_SECONDS = 1.0
"""Seconds after which a task that still runs is cancelled again; what tasks do at their end takes less, as a rule."""


async def end(*tasks: asyncio.Future[Any]) -> None:
    """Cancel tasks and wait until they have ended. What they return or raise is dropped.

    A task that still runs is cancelled again: `asyncio.wait_for`, of which libraries make use, returns the result and
    loses the cancellation if both come in the same turn of the event loop (CPython before 3.12).
    """
    running = {task for task in tasks if not task.done()}
    while running:
        for task in running:
            task.cancel()
        _, running = await asyncio.wait(running, timeout=_AGAIN_SECONDS)
    for task in tasks:
        if not task.cancelled():
            task.exception()  # otherwise asyncio reports it as not retrieved
