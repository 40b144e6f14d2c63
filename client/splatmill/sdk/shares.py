"""The links to a model: `AsyncModelHandle.shares` and `ModelHandle.shares`."""

from splatmill.errors import valid_request
from splatmill.schema import CreateShare, Share, ShareList, ShareWithToken
from splatmill.transfer.connection import Connection, read_answer


class AsyncShares:
    """Creates, lists and revokes the links to a model. Whoever has a link may see the model, without a key."""

    def __init__(self, connection: Connection, model_id: str) -> None:
        self._connection = connection
        self._path = f"/v1/models/{model_id}/shares"

    async def create(
        self, *, expires_in: float | str = "30d", name: str | None = None, photos: bool = False
    ) -> ShareWithToken:
        """Create a link. `path` of the returned one is its address on the server, which cannot show it again.

        expires_in: for how long it is valid: seconds, or a text such as 12h or 30d.
        photos: whether the held-out photos and the page of the report, which shows some, go along.

        Raises InvalidRequest for a time that is not valid.
        """
        request = valid_request(CreateShare, {"expires_in": expires_in, "name": name, "photos": photos})
        # It is sent once: repeated after a lost answer, it would leave a link that nobody knows of.
        response = await self._connection.request("POST", self._path, json=request.model_dump(mode="json"))
        return read_answer(ShareWithToken, response)

    async def revoke(self, share_id: str) -> None:
        """Revoke a link at once and for good."""
        await self._connection.request("DELETE", f"{self._path}/{share_id}")

    async def list(self) -> list[Share]:
        """Return the links, newest first, also those that have ended, without their tokens."""
        return read_answer(ShareList, await self._connection.request("GET", self._path)).shares
