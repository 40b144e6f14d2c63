"""A lease that one API process holds is free again in time, also where the clock of Redis was set back.

Not proved here: that the work which a lease protects is done once (tests/server/webhooks, tests/server/captures).
"""

import asyncio

import redis

from splatmill.backplane import keys
from splatmill_server import leases
from splatmill_server.leases import lease


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
