"""The keys of a server: `AsyncClient.keys` and `Client.keys`, for callers with the scope admin."""

from collections.abc import Iterable, Mapping
from typing import Any

from splatmill.errors import valid_request
from splatmill.schema import (
    DEFAULT_OWNER,
    CreateKey,
    Key,
    KeyLimits,
    KeyList,
    KeyWithSecret,
    RotateKey,
    Scope,
)
from splatmill.transfer.connection import Connection, read_answer


class AsyncKeys:
    """Creates, lists, revokes and rotates the keys of a server."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    async def create(
        self,
        name: str,
        *,
        owner: str = DEFAULT_OWNER,
        scopes: Iterable[Scope | str] = (Scope.read, Scope.train),
        limits: KeyLimits | Mapping[str, Any] | None = None,
    ) -> KeyWithSecret:
        """Create a key. `secret` of the returned key is what clients send; the server cannot show it again.

        limits: `unfinished_jobs`, `bytes_stored` and `requests_per_minute`; what is left out has no limit.

        Raises Conflict if the first key of a server does not have the scope admin.
        """
        limit_values = limits.model_dump() if isinstance(limits, KeyLimits) else dict(limits or {})
        body = {"name": name, "owner": owner, "scopes": list(scopes), "limits": limit_values}
        request = valid_request(CreateKey, body)
        # It is sent once: repeated after a lost answer, it would leave a key that nobody knows of.
        response = await self._connection.request("POST", "/v1/keys", json=request.model_dump(mode="json"))
        return read_answer(KeyWithSecret, response)

    async def list(self) -> list[Key]:
        """Return the keys, the oldest first."""
        return read_answer(KeyList, await self._connection.request("GET", "/v1/keys")).keys

    async def revoke(self, key_id: str) -> None:
        """Revoke a key. The server refuses it within two seconds.

        Raises NotFound, and Conflict for the last key with the scope admin.
        """
        await self._connection.request("DELETE", f"/v1/keys/{key_id}")

    async def rotate(self, key_id: str, *, grace: float | str = 0.0) -> KeyWithSecret:
        """Give a key a new secret. The former one stays valid for `grace`: seconds, or a text such as `1h`."""
        request = valid_request(RotateKey, {"grace": grace})
        path = f"/v1/keys/{key_id}/rotate"
        response = await self._connection.request("POST", path, json=request.model_dump(mode="json"))
        return read_answer(KeyWithSecret, response)
