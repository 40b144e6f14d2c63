"""The queue of the requests to render: one at a time, and a bounded number waiting."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import TypeVar

from starlette.concurrency import run_in_threadpool

Result = TypeVar("Result")


class QueueFull(Exception):
    """The queue has no place for another request."""


class ClientGone(Exception):
    """The client that asked for the work has closed its connection."""


class RenderQueue:
    """Runs one piece of work at a time, so that it has all cores, and lets at most `max_waiting` more requests wait."""

    def __init__(self, max_waiting: int) -> None:
        self._max_admitted = max_waiting + 1
        self._admitted = 0
        self._lock = asyncio.Lock()

    @contextlib.asynccontextmanager
    async def admitted(self) -> AsyncIterator[None]:
        """Hold a place in the queue while a request is served. Raises QueueFull when there is none."""
        if self._admitted >= self._max_admitted:
            raise QueueFull
        self._admitted += 1
        try:
            yield
        finally:
            self._admitted -= 1

    async def run(
        self, work: Callable[[], Result], gone: Callable[[], Awaitable[bool]] | None = None
    ) -> Result:
        """Run blocking work in a thread, once no other work runs, and return its result.

        Raises ClientGone in place of running it if `gone`, which is asked then, returns true.
        """
        async with self._lock:
            if gone is not None and await gone():
                raise ClientGone
            return await run_in_threadpool(work)
