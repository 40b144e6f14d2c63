"""The webhooks of a server: `AsyncClient.webhooks` and `Client.webhooks`."""

from collections.abc import Iterable

from splatmill.errors import valid_request
from splatmill.schema import (
    CreateWebhook,
    Delivery,
    DeliveryList,
    Webhook,
    WebhookEvent,
    WebhookList,
    WebhookWithSecret,
)
from splatmill.transfer.connection import Connection, read_answer

PATH = "/v1/webhooks"


class AsyncWebhooks:
    """Creates, lists and deletes webhooks, and reads the log of their deliveries."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    async def create(
        self, url: str, *, events: Iterable[WebhookEvent | str] | None = None, name: str | None = None
    ) -> WebhookWithSecret:
        """Create a webhook. `secret` of the returned one verifies its requests; the server cannot show it again.

        events: `job.succeeded`, `job.failed` and `job.cancelled`; left out, all of them.

        Raises InvalidRequest for an address that the server sends nothing to.
        """
        body = {"url": url, "name": name} | ({} if events is None else {"events": list(events)})
        request = valid_request(CreateWebhook, body)
        # It is sent once: repeated after a lost answer, it would leave a webhook whose secret nobody knows.
        response = await self._connection.request("POST", PATH, json=request.model_dump(mode="json"))
        return read_answer(WebhookWithSecret, response)

    async def delete(self, webhook_id: str) -> None:
        """Delete a webhook and its log."""
        await self._connection.request("DELETE", f"{PATH}/{webhook_id}")

    async def rotate(self, webhook_id: str) -> WebhookWithSecret:
        """Give a webhook a new secret. For 24 hours, its requests are signed with the former one too."""
        response = await self._connection.request("POST", f"{PATH}/{webhook_id}/rotate")
        return read_answer(WebhookWithSecret, response)

    async def enable(self, webhook_id: str) -> Webhook:
        """Let the server send to a disabled webhook again."""
        return read_answer(Webhook, await self._connection.request("POST", f"{PATH}/{webhook_id}/enable"))

    async def deliveries(self, webhook_id: str) -> list[Delivery]:
        """Return the deliveries of a webhook, newest first, with every attempt."""
        response = await self._connection.request("GET", f"{PATH}/{webhook_id}/deliveries")
        return read_answer(DeliveryList, response).deliveries

    async def repeat(self, webhook_id: str, delivery_id: str) -> Delivery:
        """Let the server send a delivery that is over once more."""
        path = f"{PATH}/{webhook_id}/deliveries/{delivery_id}/repeat"
        return read_answer(Delivery, await self._connection.request("POST", path))

    async def list(self) -> list[Webhook]:
        """Return the webhooks, the oldest first."""
        return read_answer(WebhookList, await self._connection.request("GET", PATH)).webhooks
