"""Redis clients for the server and the worker, with the same timeouts, retries and encoding."""

from typing import Any

import redis
import redis.asyncio
from redis.asyncio.retry import Retry as AsyncRetry
from redis.backoff import ExponentialBackoff
from redis.retry import Retry

from splatmill.backplane.address import DEFAULT_URL
from splatmill.backplane.redact import redacted
from splatmill.backplane.refusal import RefusalAwareRedis

ASYNC_CONNECTIONS = 32
"""Largest number of connections of an asyncio client. Those who follow events share one."""

_FREE_SECONDS = 20
"""Seconds that a command waits for a free connection, after which it fails as if Redis could not be reached."""


class InvalidRedisUrl(ValueError):
    """The address of Redis is not valid. The message shows it without its password."""

    def __init__(self, url: str) -> None:
        super().__init__(
            f"REDIS_URL, {redacted(url)}, is not the address of a Redis; write it as redis://host:port/0 or "
            "unix:///path, with the special characters of a password percent-encoded."
        )


def connect(url: str = DEFAULT_URL, *, timeout: float | None = None, retries: int = 3) -> redis.Redis:
    """Return a synchronous client, which connects on first use. Its replies are bytes, as RQ expects.

    It raises redis.ConnectionError also if Redis answers and refuses (see `refusal`).

    url: `redis://host:port/db` or `unix:///path/to/redis.sock`.
    timeout: seconds to wait for a reply; None waits for ever.
    retries: how often a command is retried after a lost connection. The API, which must answer, uses few.

    Raises InvalidRedisUrl.
    """
    try:
        return RefusalAwareRedis.from_url(
            url,
            socket_timeout=timeout,
            health_check_interval=15,
            retry=Retry(ExponentialBackoff(cap=2, base=0.1), retries),
            **_connect_timeout(url),
        )
    except ValueError:
        raise InvalidRedisUrl(url) from None  # the original message may quote a part of the password


def connect_async(url: str = DEFAULT_URL) -> redis.asyncio.Redis:
    """Return an asyncio client for reading streams. It has no timeout: `XREAD BLOCK` and `BRPOP` wait by design.

    It opens at most ASYNC_CONNECTIONS; a command waits for a free one.

    Raises InvalidRedisUrl.
    """
    try:
        pool = redis.asyncio.BlockingConnectionPool.from_url(
            url,
            max_connections=ASYNC_CONNECTIONS,
            timeout=_FREE_SECONDS,
            socket_timeout=None,
            health_check_interval=15,
            retry=AsyncRetry(ExponentialBackoff(cap=2, base=0.1), 1),
            **_connect_timeout(url),
        )
        return redis.asyncio.Redis.from_pool(pool)
    except ValueError:
        raise InvalidRedisUrl(url) from None


def _connect_timeout(url: str) -> dict[str, Any]:
    return {} if url.startswith("unix:") else {"socket_connect_timeout": 3}
