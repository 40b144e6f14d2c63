"""A lease that one API process holds is free again in time, also where the clock of Redis was set back.

Not proved here: that the work which a lease protects is done once (tests/server/background).
"""

import asyncio
import time

import pytest
import redis

from splatmill.backplane import keys
from splatmill_server.base import leases
from splatmill_server.base.leases import exclusive, lease
from tests.support.waiting import wait_for


async def taken(connection: redis.Redis) -> bool:
    async with lease(connection, "work", "a") as mine:
        return mine


def test_one_process_holds_a_lease_at_a_time(connection: redis.Redis) -> None:
    async def both() -> tuple[bool, bool]:
        async with lease(connection, "work", "a") as first:
            return first, await taken(connection)

    assert asyncio.run(both()) == (True, False)
    assert asyncio.run(taken(connection))


def test_a_lease_lasts_no_longer_where_the_clock_of_redis_is_set_back(connection: redis.Redis) -> None:
    name = keys.lease("work", "a")
    connection.set(name, "a process that was killed", ex=1800)  # as seen after half an hour back
    assert not asyncio.run(taken(connection))
    assert 0 < connection.ttl(name) <= leases.SECONDS


def test_the_event_loop_goes_on_while_redis_does_not_answer_the_release(connection: redis.Redis) -> None:
    async def longest_pause() -> float:
        paused, longest = time.monotonic(), 0.0

        async def tick() -> None:
            nonlocal paused, longest
            while True:
                await asyncio.sleep(0.01)
                longest, paused = max(longest, time.monotonic() - paused), time.monotonic()

        async with lease(connection, "work", "a") as mine:
            assert mine
            ticking = asyncio.create_task(tick())
            await asyncio.sleep(0.05)
            connection.client_pause(1000)
        await asyncio.sleep(0.05)
        ticking.cancel()
        return longest

    assert asyncio.run(longest_pause()) < 0.5
    assert connection.get(keys.lease("work", "a")) is None


def test_a_cancelled_holder_releases_its_lease(connection: redis.Redis) -> None:
    async def cancelled_twice() -> None:
        async def hold() -> None:
            async with lease(connection, "work", "a"):
                held.set()
                await asyncio.sleep(60)

        held = asyncio.Event()
        task = asyncio.create_task(hold())
        await held.wait()
        connection.client_pause(200)
        task.cancel()
        await asyncio.sleep(0.05)
        task.cancel()
        await asyncio.wait({task})

    asyncio.run(cancelled_twice())
    wait_for(lambda: connection.get(keys.lease("work", "a")) is None)


def test_changes_of_one_record_wait_for_each_other_and_not_for_ever(
    connection: redis.Redis, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(leases, "_WAIT", 0.2)
    with exclusive(connection, "webhook", "a"):
        with exclusive(connection, "webhook", "b"):
            pass
        with pytest.raises(redis.RedisError), exclusive(connection, "webhook", "a"):
            pass
    with exclusive(connection, "webhook", "a"):
        pass
