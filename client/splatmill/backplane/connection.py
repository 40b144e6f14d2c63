"""Redis clients for the server and the worker, with the same timeouts, retries and encoding."""

from typing import Any

import redis
import redis.asyncio
from redis.asyncio.retry import Retry as AsyncRetry
from redis.backoff import ExponentialBackoff
from redis.retry import Retry

DEFAULT_URL = "redis://127.0.0.1:6379/0"


def connect(url: str = DEFAULT_URL, *, timeout: float | None = None, retries: int = 3) -> redis.Redis:
    """Return a synchronous client, which connects on first use. Its replies are bytes, as RQ expects.

    url: `redis://host:port/db` or `unix:///path/to/redis.sock`.
    timeout: seconds to wait for a reply; None waits for ever.
    retries: how often a command is retried after a lost connection. The API, which must answer, uses few.
    """
    return redis.Redis.from_url(
        url,
        socket_timeout=timeout,
        health_check_interval=15,
        retry=Retry(ExponentialBackoff(cap=2, base=0.1), retries),
        **_connect_timeout(url),
    )


def connect_async(url: str = DEFAULT_URL) -> redis.asyncio.Redis:
    """Return an asyncio client for reading streams. It has no timeout, because `XREAD BLOCK` waits by design."""
    return redis.asyncio.Redis.from_url(
        url,
        health_check_interval=15,
        retry=AsyncRetry(ExponentialBackoff(cap=2, base=0.1), 1),
        **_connect_timeout(url),
    )


def _connect_timeout(url: str) -> dict[str, Any]:
    return {} if url.startswith("unix:") else {"socket_connect_timeout": 3}
