"""The queue of the requests to render: one at a time, owners in turn, and a bounded number waiting."""

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
    """Runs one piece of work at a time, so that it has all cores but for what another queue runs.

    A client is named by its owner and a text of its own, with a slash between (`rendering.client_of`). Owners take
    turns, and so do the clients of an owner: one that asks for a hundred pictures, or for a video, which is as many,
    delays the first picture of another by one. Those of one client come in order. Views of one model are not rendered
    together, which would gain nothing (decisions: view-batches).

    max_waiting: requests that may wait beside the one that is served.
    max_of_client: requests of one client that may be in the queue; None: as many as fit.
    max_of_owner: requests of one owner that may be in the queue; None: as many as fit.
    reserved: places that only an owner with no other request in the queue gets.
    """

    def __init__(
        self,
        max_waiting: int,
        max_of_client: int | None = None,
        max_of_owner: int | None = None,
        reserved: int = 0,
    ) -> None:
        self._max_admitted = max_waiting + 1
        self._max_of_client = max_of_client or self._max_admitted
        self._max_of_owner = max_of_owner or self._max_admitted
        self._reserved = reserved
        self._clients: Counter[str] = Counter()
        self._owners: Counter[str] = Counter()
        self._busy = False
        # Those that wait for their turn, by owner and client; the first client of the first owner is next.
        self._waiting: OrderedDict[str, OrderedDict[str, deque[asyncio.Future[None]]]] = OrderedDict()

    @property
    def admitted_count(self) -> int:
        """Number of requests that wait or are served."""
        return self._owners.total()

    @contextlib.asynccontextmanager
    async def admitted(self, client: str = "") -> AsyncIterator[None]:
        """Hold a place in the queue while a request of a client is served. Raises QueueFull when there is none."""
        owner = _owner(client)
        places = self._max_admitted - (self._reserved if self._owners[owner] else 0)
        if (
            self._owners.total() >= places
            or self._owners[owner] >= self._max_of_owner
            or self._clients[client] >= self._max_of_client
        ):
            raise QueueFull
        self._owners[owner] += 1
        self._clients[client] += 1
        try:
            yield
        finally:
            self._owners[owner] -= 1
            self._clients[client] -= 1
            self._owners, self._clients = +self._owners, +self._clients  # without those that have none

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
        clients = self._waiting.setdefault(_owner(client), OrderedDict())
        clients.setdefault(client, deque()).append(turn)
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
        clients = self._waiting[_owner(client)]
        clients[client].remove(turn)
        if not clients[client]:
            del clients[client]
        if not clients:
            del self._waiting[_owner(client)]

    def _next(self) -> None:
        """Give the turn to the next owner and client that wait, and put them behind the others."""
        if not self._waiting:
            self._busy = False
            return
        owner, clients = self._waiting.popitem(last=False)
        client, turns = clients.popitem(last=False)
        turns.popleft().set_result(None)
        if turns:
            clients[client] = turns
        if clients:
            self._waiting[owner] = clients


def _owner(client: str) -> str:
    return client.partition("/")[0]
