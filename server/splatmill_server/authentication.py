"""Finds the caller of a request: from the key that it carries, or as everybody's of a server without keys."""

import hashlib
import hmac

from starlette.datastructures import Headers

from splatmill_server.caller import BOOTSTRAP, KEYLESS, Caller
from splatmill_server.keys import Keys, StoredKey
from splatmill_server.problems import ProblemError
from splatmill_server.settings import Settings


class Authentication:
    """Finds callers. Raises ProblemError for a request without a valid key, and StorageError if keys cannot be read."""

    def __init__(self, settings: Settings, keys: Keys) -> None:
        given = settings.api_key.get_secret_value() if settings.api_key is not None else None
        self._bootstrap = _digest(given) if given is not None else None
        self._local = settings.local
        self._keys = keys

    async def caller(self, headers: Headers) -> Caller:
        """Return the caller of a request with these headers."""
        given = _bearer(headers)
        if (
            given is not None
            and self._bootstrap is not None
            and hmac.compare_digest(_digest(given), self._bootstrap)
        ):
            return BOOTSTRAP
        await self._keys.current()
        if given is not None and (key := self._keys.find(given)) is not None:
            return caller_of(key)
        if self._bootstrap is None and self._local and not self._keys.any():
            return KEYLESS
        raise ProblemError(
            "unauthorized",
            "The request has no API key, or a wrong one.",
            advice="Send the header 'Authorization: Bearer KEY'. A key in the address is ignored.",
            headers={"WWW-Authenticate": "Bearer"},
        )


def caller_of(key: StoredKey) -> Caller:
    """Return the caller that sends a stored key."""
    return Caller(key.owner, key.id, key.name, frozenset(key.scopes), key.limits)


def _bearer(headers: Headers) -> str | None:
    scheme, _, given = headers.get("authorization", "").partition(" ")
    return given.strip() if scheme.lower() == "bearer" else None


def _digest(secret: str) -> bytes:
    return hashlib.sha256(secret.encode()).digest()
