"""One way to open Redis, so that server and worker agree on time-outs and encoding."""

import redis
import redis.asyncio

DEFAULT_URL = "redis://127.0.0.1:6379/0"


def connect(url: str = DEFAULT_URL) -> "redis.Redis":
    """A synchronous client. Replies are bytes, because RQ, which shares it, expects bytes.

    `unix:///path/to/redis.sock` and `redis://host:port/db` are both understood. No connection is made yet.
    """
    return redis.Redis.from_url(url, socket_connect_timeout=3, health_check_interval=15)


def connect_async(url: str = DEFAULT_URL) -> "redis.asyncio.Redis":
    """An asyncio client for waiting on streams, without a read time-out of its own (`XREAD BLOCK` waits)."""
    return redis.asyncio.Redis.from_url(url, socket_connect_timeout=3, health_check_interval=15)
