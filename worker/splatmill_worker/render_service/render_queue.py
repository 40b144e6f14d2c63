"""The queue of the requests to render: one at a time, and a bounded number waiting."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from typing import TypeVar

from starlette.concurrency import run_in_threadpool

Result = TypeVar("Result")


class QueueFull(Exception):
    """The queue has no place for another request."""


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

    async def run(self, work: Callable[[], Result]) -> Result:
        """Run blocking work in a thread, once no other work runs, and return its result."""
        async with self._lock:
            return await run_in_threadpool(work)
