"""The rate of requests of a key: a token bucket in Redis, which all API processes share.

The bucket holds the requests of one minute, and fills up evenly. It is stored as the time at which it is full again
(the "theoretical arrival time" of the generic cell rate algorithm, ITU-T I.371), by the clock of Redis.
"""

import asyncio
import math
from typing import Any, cast

import redis
import structlog
from redis.asyncio import Redis as AsyncRedis

from splatmill.backplane import keys
from splatmill_server.access.caller import Caller
from splatmill_server.base.problems import ProblemError

log = structlog.get_logger()

WAIT_SECONDS = 1.0
"""Seconds to wait for Redis, after which the request is admitted."""

# KEYS[1]: the bucket. ARGV[1]: requests a minute. Returns the milliseconds until there is room for a request, or 0.
_TAKE = """
local time = redis.call('TIME')
local now = time[1] * 1000 + time[2] / 1000
local full = math.max(now, tonumber(redis.call('GET', KEYS[1]) or '0')) + 60000 / tonumber(ARGV[1])
local wait = full - now - 60000
if wait > 0.001 then return math.ceil(wait) end
redis.call('SET', KEYS[1], string.format('%.3f', full), 'PX', 120000)
return 0
"""


class Rate:
    """Counts requests. Without Redis, every request is admitted: those that need no Redis go on."""

    def __init__(self, connection: AsyncRedis) -> None:
        self._take = connection.register_script(_TAKE)

    async def admit(self, caller: Caller) -> None:
        """Count a request. Raises a 429 problem with Retry-After if the caller's key has used up its minute."""
        limit = caller.limits.requests_per_minute
        if limit is None or caller.key_id is None:
            return
        taking = cast(Any, self._take(keys=[keys.rate(caller.key_id)], args=[limit]))
        try:
            async with asyncio.timeout(WAIT_SECONDS):
                wait = await taking
        except (redis.RedisError, TimeoutError) as error:
            log.warning("the rate of requests is not limited", error=type(error).__name__)
            return
        if wait:
            seconds = math.ceil(int(wait) / 1000)
            raise ProblemError(
                "too_many_requests",
                f"The API key {caller.key_name!r} has made its {limit} requests a minute.",
                advice=f"Try again in {seconds} s.",
                facts={"requests_per_minute": limit, "retry_after": seconds},
                headers={"Retry-After": str(seconds)},
            )
