"""Sessions of browsers: a key exchanged for a cookie, which scripts of a page cannot read.

A session is stored in Redis under the digest of its cookie, with the digest of the secret that it was made from. It
ends when it expires, when it is ended, and with that secret.
"""

import asyncio
import json
import secrets
from collections.abc import Awaitable
from dataclasses import asdict, dataclass
from typing import Any, TypeVar

import redis
from redis.asyncio import Redis as AsyncRedis

from splatmill.backplane import keys
from splatmill_server.access.keys import digest

COOKIE = "splatmill_session"
"""Name of the cookie."""

T = TypeVar("T")


@dataclass(frozen=True)
class Session:
    """What a cookie stands for.

    key_id: id of the stored key, or None for the key of SPLATMILL_API_KEY.
    secret: SHA-256 in hex of the secret that the session was made from.
    """

    key_id: str | None
    secret: str


class Sessions:
    """Makes, gets and deletes sessions. Raises redis.RedisError if Redis cannot be reached.

    seconds: how long a session lasts.
    timeout: seconds to wait for a reply of Redis.
    """

    def __init__(self, connection: AsyncRedis, seconds: int, timeout: float) -> None:
        self._connection = connection
        self.seconds = seconds
        self._timeout = timeout

    async def create(self, session: Session) -> str:
        """Store a session and return its cookie, of 256 random bits."""
        cookie = secrets.token_hex(32)
        record = json.dumps(asdict(session))
        await self._reply(self._connection.set(keys.session(digest(cookie)), record, ex=self.seconds))
        return cookie

    async def get(self, cookie: str) -> Session | None:
        """Return the session of a cookie, or None."""
        record = await self._reply(self._connection.get(keys.session(digest(cookie))))
        return Session(**json.loads(record)) if record is not None else None

    async def delete(self, cookie: str) -> None:
        """Forget a session, if there is one."""
        await self._reply(self._connection.delete(keys.session(digest(cookie))))

    async def _reply(self, pending: Awaitable[T] | Any) -> Any:
        try:
            async with asyncio.timeout(self._timeout):
                return await pending
        except TimeoutError as error:
            raise redis.TimeoutError("Redis did not answer in time.") from error
