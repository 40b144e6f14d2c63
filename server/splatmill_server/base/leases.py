"""Leases in Redis: of all API processes, one at a time works on a thing. A lease that is not renewed expires."""

import asyncio
import secrets
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress

import redis
from redis.exceptions import LockError
from redis.lock import Lock
from starlette.concurrency import run_in_threadpool

from splatmill.backplane import expiry, keys
from splatmill_server.base import cancelling

SECONDS = 30
"""Seconds until the lease of a process that was killed expires."""

_WAIT = 10.0
"""Seconds that a change of a record waits for others of the same record."""

_RELEASE = "if redis.call('get', KEYS[1]) == ARGV[1] then return redis.call('del', KEYS[1]) end return 0"
_RENEW = (
    "if redis.call('get', KEYS[1]) == ARGV[1] then return redis.call('expire', KEYS[1], ARGV[2]) end return 0"
)


@asynccontextmanager
async def lease(connection: redis.Redis, kind: str, name: str) -> AsyncIterator[bool]:
    """Hold the lease on a thing while the context is open; yield False if another process holds it.

    Raises redis.RedisError if the lease cannot be taken. If Redis is lost while it is held, the work continues: what a
    lease protects must be safe, though wasteful, to do twice.
    """
    key, token = keys.lease(kind, name), secrets.token_hex(8)
    if not await run_in_threadpool(lambda: connection.set(key, token, nx=True, ex=SECONDS)):
        await run_in_threadpool(expiry.shorten, connection, key, SECONDS)
        yield False
        return
    renewal = asyncio.create_task(_renew(connection, key, token))
    try:
        yield True
    finally:
        try:
            with suppress(redis.RedisError):
                # Shielded: a second cancellation, as while the server stops, must not keep the lease for SECONDS.
                await asyncio.shield(
                    asyncio.ensure_future(run_in_threadpool(connection.eval, _RELEASE, 1, key, token))
                )
        finally:
            await cancelling.end(renewal)


@contextmanager
def exclusive(connection: redis.Redis, kind: str, name: str) -> Iterator[Callable[[], object]]:
    """Hold the lease on a record, from its reading to its writing, and wait for others that do. For threads.

    Yield a function that lets the lease last SECONDS from then on, and raises LockError if it has expired.

    Raises redis.RedisError, LockError among them, if the lease cannot be taken.
    """
    key = keys.lease(kind, name)
    lock = Lock(connection, key, timeout=SECONDS, thread_local=False, raise_on_release_error=False)
    if not lock.acquire(blocking_timeout=_WAIT):
        expiry.shorten(connection, key, SECONDS)
        raise LockError("The record is being changed by other requests")
    try:
        yield lock.reacquire
    finally:
        with suppress(redis.RedisError):
            lock.release()


async def keep_for(connection: redis.Redis, kind: str, name: str, seconds: float) -> None:
    """Let nobody work on a thing for some seconds, at most SECONDS. Called while its lease is held.

    Raises redis.RedisError.
    """
    milliseconds = max(1, min(round(seconds * 1000), SECONDS * 1000))
    # With another value than the token of the lease, which its end therefore leaves.
    await run_in_threadpool(lambda: connection.set(keys.lease(kind, name), "pause", px=milliseconds))


async def _renew(connection: redis.Redis, key: str, token: str) -> None:
    while True:
        await asyncio.sleep(SECONDS / 3)
        with suppress(redis.RedisError):
            await run_in_threadpool(connection.eval, _RENEW, 1, key, token, str(SECONDS))
