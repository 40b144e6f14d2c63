"""One way to open Redis, so that server and worker agree on time-outs and encoding."""

from typing import Any

import redis
import redis.asyncio
from redis.asyncio.retry import Retry as AsyncRetry
from redis.backoff import ExponentialBackoff
from redis.retry import Retry

DEFAULT_URL = "redis://127.0.0.1:6379/0"


def connect(url: str = DEFAULT_URL, *, timeout: float | None = None, retries: int = 3) -> redis.Redis:
    """A synchronous client. Replies are bytes, because RQ, which shares it, expects bytes.

    `unix:///path/to/redis.sock` and `redis://host:port/db` are both understood; no connection is made yet.
    `timeout` (seconds) bounds the wait for a reply, `retries` how often a lost connection is tried anew: an API
    that must answer takes few, a worker that can wait takes the defaults.
    """
    return redis.Redis.from_url(
        url,
        socket_timeout=timeout,
        health_check_interval=15,
        retry=Retry(ExponentialBackoff(cap=2, base=0.1), retries),
        **_connect_timeout(url),
    )


def connect_async(url: str = DEFAULT_URL) -> redis.asyncio.Redis:
    """An asyncio client for waiting on streams, without a time-out of its own (`XREAD BLOCK` waits)."""
    return redis.asyncio.Redis.from_url(
        url,
        health_check_interval=15,
        retry=AsyncRetry(ExponentialBackoff(cap=2, base=0.1), 1),
        **_connect_timeout(url),
    )


def _connect_timeout(url: str) -> dict[str, Any]:
    return {} if url.startswith("unix:") else {"socket_connect_timeout": 3}
