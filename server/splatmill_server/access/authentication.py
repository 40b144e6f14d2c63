"""Finds the caller of a request: by a key, by the cookie of a session, or as anybody on a server without keys."""

import hmac
import time
from collections.abc import Awaitable, Callable
from dataclasses import replace

import redis
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.types import Scope

from splatmill.backplane.storage.storage import StorageError
from splatmill_server.access.browsers import check_host, check_origin
from splatmill_server.access.caller import BOOTSTRAP, KEYLESS, Caller
from splatmill_server.access.keys import CACHE_SECONDS, Keys, digest
from splatmill_server.access.sessions import COOKIE, Session, Sessions
from splatmill_server.base.problems import ProblemError
from splatmill_server.base.settings import Settings


class Authentication:
    """Finds callers. Raises ProblemError for a request that is refused, StorageError if keys cannot be read, and
    redis.RedisError if a session cannot be looked up."""

    def __init__(self, settings: Settings, keys: Keys, sessions: Sessions) -> None:
        bootstrap = settings.api_key.get_secret_value() if settings.api_key is not None else None
        self._bootstrap = digest(bootstrap) if bootstrap is not None else None
        self._settings = settings
        self._keys = keys
        self._sessions = sessions

    async def caller(self, scope: Scope, headers: Headers) -> Caller:
        """Return the caller of a request."""
        secret = bearer(headers)
        if secret is not None and (known := self._of_bootstrap(digest(secret))) is not None:
            return known
        await self._keys.current()
        if secret is not None and (key := self._keys.get_by_secret(secret)) is not None:
            return Caller.of(key)
        if self._bootstrap is None and self._settings.local and not self._keys.any():
            check_host(scope, headers, self._settings.host, self._settings.own_names)
            check_origin(scope, headers, self._settings.own_names, self._settings.cors, required=False)
            return KEYLESS
        cookie = session_cookie(headers)
        if secret is None and cookie and (session := await self._sessions.get(cookie)) is not None:
            known = self._of_session(session)
            if known is not None:
                check_origin(scope, headers, self._settings.own_names, required=True)
                return replace(known, by_session=True)
        raise ProblemError(
            "unauthorized",
            "The request has no API key, or a wrong one.",
            advice="Send the header 'Authorization: Bearer KEY'. A key in the address is ignored.",
            headers={"WWW-Authenticate": "Bearer"},
        )

    def again(self, request: Request) -> Callable[[], Awaitable[bool]]:
        """Return a function that checks, every CACHE_SECONDS, whether the request would still be accepted."""
        looked, let_in = time.monotonic(), True

        async def permitted() -> bool:
            nonlocal looked, let_in
            if time.monotonic() - looked > CACHE_SECONDS:
                try:
                    await self.caller(request.scope, request.headers)
                except (ProblemError, StorageError, redis.RedisError):
                    let_in = False
                looked = time.monotonic()
            return let_in

        return permitted

    def _of_bootstrap(self, sha256: str) -> Caller | None:
        known = self._bootstrap
        return (
            BOOTSTRAP if known is not None and hmac.compare_digest(sha256.encode(), known.encode()) else None
        )

    def _of_session(self, session: Session) -> Caller | None:
        """Return the caller of a session whose secret is still valid, or None."""
        if session.key_id is None:
            return self._of_bootstrap(session.secret)
        key = self._keys.get_if_valid(session.key_id, session.secret)
        return Caller.of(key) if key is not None else None


def bearer(headers: Headers) -> str | None:
    """Return the key in the header Authorization, or None."""
    scheme, _, token = headers.get("authorization", "").partition(" ")
    return token.strip() if scheme.lower() == "bearer" else None


def session_cookie(headers: Headers) -> str | None:
    """Return the cookie of a session, or None."""
    pairs = (part.strip().partition("=") for part in headers.get("cookie", "").split(";"))
    # A browser sends the cookie of the longest path first: that of a server under another one comes after it.
    return next((value for name, _, value in pairs if name == COOKIE), None) or None
