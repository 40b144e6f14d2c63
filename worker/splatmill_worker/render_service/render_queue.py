"""The queue of the requests to render: one at a time, clients in turn, and a bounded number waiting."""

import asyncio
import contextlib
from collections import Counter, OrderedDict, deque
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import TypeVar

from starlette.concurrency import run_in_threadpool

LOOK_SECONDS = 0.25
"""Seconds between two looks whether the client of a request that waits is still there."""

Result = TypeVar("Result")


class QueueFull(Exception):
    """The queue has no place for another request, or none for another one of this client."""


class ClientGone(Exception):
    """The client that asked for the work has closed its connection."""


class RenderQueue:
    """Runs one piece of work at a time, so that it has all cores.

    Clients take turns: one that asks for a hundred pictures, or for a video, which is as many, delays the first picture
    of another by one. Those of one client come in order. Views of one model are not rendered together, which would gain
    nothing (decisions: view-batches).

    max_waiting: requests that may wait beside the one that is served.
    max_of_client: requests of one client that may be in the queue; None: as many as fit.
    """

    def __init__(self, max_waiting: int, max_of_client: int | None = None) -> None:
        self._max_admitted = max_waiting + 1
        self._max_of_client = max_of_client or self._max_admitted
        self._admitted: Counter[str] = Counter()
        self._busy = False
        # Those that wait for their turn, by client; the first client is next.
        self._waiting: OrderedDict[str, deque[asyncio.Future[None]]] = OrderedDict()

    @property
    def admitted_count(self) -> int:
        """Number of requests that wait or are served."""
        return self._admitted.total()

    @contextlib.asynccontextmanager
    async def admitted(self, client: str = "") -> AsyncIterator[None]:
        """Hold a place in the queue while a request of a client is served. Raises QueueFull when there is none."""
        if self._admitted.total() >= self._max_admitted or self._admitted[client] >= self._max_of_client:
            raise QueueFull
        self._admitted[client] += 1
        try:
            yield
        finally:
            self._admitted[client] -= 1
            if not self._admitted[client]:
                del self._admitted[client]

    async def run(
        self,
        work: Callable[[], Result],
        gone: Callable[[], Awaitable[bool]] | None = None,
        client: str = "",
    ) -> Result:
        """Run blocking work in a thread, once it is its turn, and return its result.

        Raises ClientGone in place of running it as soon as `gone`, which is asked while it waits, returns true.
        """
        await self._turn(client, gone)
        try:
            if gone is not None and await gone():
                raise ClientGone
            return await run_in_threadpool(work)
        finally:
            self._next()

    async def _turn(self, client: str, gone: Callable[[], Awaitable[bool]] | None) -> None:
        """Wait until no other work runs and it is the turn of this one."""
        if not self._busy:
            self._busy = True
            return
        turn: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.setdefault(client, deque()).append(turn)
        try:
            while not turn.done():
                await asyncio.wait({turn}, timeout=LOOK_SECONDS)
                if not turn.done() and gone is not None and await gone():
                    raise ClientGone
        except BaseException:
            if turn.done():
                self._next()  # it came at the same moment, and is passed on
            else:
                self._leave(client, turn)
            raise

    def _leave(self, client: str, turn: "asyncio.Future[None]") -> None:
        self._waiting[client].remove(turn)
        if not self._waiting[client]:
            del self._waiting[client]

    def _next(self) -> None:
        """Give the turn to the next client that waits, and put that client behind the others."""
        if not self._waiting:
            self._busy = False
            return
        client, turns = self._waiting.popitem(last=False)
        turns.popleft().set_result(None)
        if turns:
            self._waiting[client] = turns
