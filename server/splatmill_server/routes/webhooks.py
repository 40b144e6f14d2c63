"""The endpoints of `/v1/webhooks`: addresses that are told of the ends of jobs, and the log of deliveries."""

from typing import Annotated

from fastapi import APIRouter, Body, Depends, Path
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from splatmill.schema import CreateWebhook, Delivery, DeliveryList, Webhook, WebhookList, WebhookWithSecret
from splatmill_server.access.caller import Who
from splatmill_server.base.outgoing import OutgoingError
from splatmill_server.base.problems import ProblemError
from splatmill_server.requests.ownership import ListedOwner
from splatmill_server.requests.parameters import JSON_ONLY
from splatmill_server.routes.openapi import JSON_BODY, problems
from splatmill_server.service import Shared
from splatmill_server.webhooks import webhook_not_found

router = APIRouter(prefix="/v1/webhooks", tags=["webhooks"])

_NOT_STORED = {"Cache-Control": "no-store"}  # the answer holds a secret


def _webhook_id(
    service: Shared, who: Who, webhook_id: Annotated[str, Path(description="Id of the webhook.")]
) -> str:
    if not who.may_see(service.webhooks.get(webhook_id).owner):
        raise webhook_not_found(webhook_id)
    return webhook_id


WebhookId = Annotated[str, Depends(_webhook_id)]


@router.post(
    "",
    status_code=201,
    responses=problems("url_refused", "too_many_requests", *JSON_BODY, "storage_full"),
    dependencies=[JSON_ONLY],
)
async def create_webhook(
    service: Shared,
    who: Who,
    response: Response,
    request: Annotated[CreateWebhook, Body(examples=[{"url": "https://example.org/splats"}])],
) -> WebhookWithSecret:
    """Create a webhook. Its secret is in this answer and in no other."""
    try:
        await service.outgoing.check(request.url)
    except OutgoingError as error:
        raise ProblemError("url_refused", str(error), advice="Give an address that is public.") from error
    made = await run_in_threadpool(service.webhooks.create, request, who.owner)
    response.headers.update(_NOT_STORED)
    response.headers["Location"] = f"/v1/webhooks/{made.id}"
    return made


@router.get("", responses=problems())
def list_webhooks(service: Shared, owner: ListedOwner) -> WebhookList:
    """List the webhooks, the oldest first, without their secrets."""
    return WebhookList(webhooks=[record.public() for record in service.webhooks.list(owner)])


@router.get("/{webhook_id}", responses=problems("webhook_not_found"))
def get_webhook(service: Shared, webhook_id: WebhookId) -> Webhook:
    """Get a webhook without its secret."""
    return service.webhooks.get(webhook_id).public()


@router.delete("/{webhook_id}", status_code=204, responses=problems("webhook_not_found"))
def delete_webhook(service: Shared, webhook_id: WebhookId) -> Response:
    """Delete a webhook and its log. Deliveries that are pending are not sent any more."""
    service.webhooks.delete(webhook_id)
    return Response(status_code=204)


@router.post("/{webhook_id}/rotate", responses=problems("webhook_not_found"))
def rotate_webhook_secret(service: Shared, response: Response, webhook_id: WebhookId) -> WebhookWithSecret:
    """Give a webhook a new secret. For 24 hours, requests carry a signature with the former one too."""
    response.headers.update(_NOT_STORED)
    return service.webhooks.rotate(webhook_id)


@router.post("/{webhook_id}/enable", responses=problems("webhook_not_found"))
def enable_webhook(service: Shared, webhook_id: WebhookId) -> Webhook:
    """Send to a disabled webhook again."""
    return service.webhooks.enable(webhook_id).public()


@router.get("/{webhook_id}/deliveries", responses=problems("webhook_not_found"))
def list_deliveries(service: Shared, webhook_id: WebhookId) -> DeliveryList:
    """List the deliveries of a webhook, newest first, with every attempt. They are kept for 30 days."""
    return DeliveryList(deliveries=[*service.webhooks.list_deliveries(webhook_id)])


@router.post(
    "/{webhook_id}/deliveries/{delivery_id}/repeat",
    status_code=202,
    responses=problems("webhook_not_found", "delivery_not_found"),
)
async def repeat_delivery(
    service: Shared,
    webhook_id: WebhookId,
    delivery_id: Annotated[str, Path(description="Id of the delivery.")],
) -> Delivery:
    """Send a delivery that is over once more, with the same `webhook-id`."""
    return await run_in_threadpool(service.webhooks.repeat, webhook_id, delivery_id)
