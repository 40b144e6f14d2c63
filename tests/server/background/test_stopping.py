"""The loops of the server end when they are cancelled, also in the moment in which they are woken.

`asyncio.wait_for` of Python 3.11 returns instead of raising where a wait ends as it is cancelled, and a server with
such a loop never stopped. The client of Redis uses it where its sockets have a timeout.
"""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from splatmill_server.base.settings import Settings
from splatmill_server.service import Service

Loop = tuple[Callable[[], Awaitable[None]], Callable[[], None]]

LOOPS: dict[str, Callable[[Service], Loop]] = {
    "reaper": lambda service: (service.reaper.run, service.reaper.wake),
    "deliveries": lambda service: (service.deliveries.run, service.deliveries.wake),
    "imports": lambda service: (service.imports.run, service.imports.unfinished.wake),
}
"""The loops that wait in a way of their own: what runs one, and what wakes it."""


@pytest.mark.parametrize("name", LOOPS)
def test_a_loop_that_is_woken_as_it_is_cancelled_ends(tmp_path: Path, redis_url: str, name: str) -> None:
    async def ends() -> None:
        service = Service.of(Settings(redis_url=redis_url, data=tmp_path))
        run, wake = LOOPS[name](service)
        for turns in range(5):
            loop = asyncio.ensure_future(run())
            await asyncio.sleep(0.3)  # it waits for its next look
            wake()
            for _ in range(turns):
                await asyncio.sleep(0)
            loop.cancel()
            _, pending = await asyncio.wait({loop}, timeout=5)
            assert not pending, turns
            assert loop.cancelled()
        await service.close()

    asyncio.run(ends())


def test_the_loop_that_waits_for_redis_ends_whenever_it_is_cancelled(tmp_path: Path, redis_url: str) -> None:
    async def ends() -> None:
        for turns in range(1, 60, 2):
            service = Service.of(Settings(redis_url=redis_url, data=tmp_path))
            loop = asyncio.ensure_future(service.ends.run())
            for _ in range(turns):
                await asyncio.sleep(0)  # it connects, sends its request, or waits
            loop.cancel()
            _, pending = await asyncio.wait({loop}, timeout=5)
            assert not pending, turns
            await service.close()

    asyncio.run(ends())
