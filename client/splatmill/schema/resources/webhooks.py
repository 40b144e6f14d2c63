"""Webhooks: addresses that the server sends the end of jobs to, and the log of what it has sent."""

from enum import StrEnum

from pydantic import Field

from splatmill.schema.base import Label, Request, Response, Time
from splatmill.schema.resources.access import DEFAULT_OWNER, Owner
from splatmill.schema.resources.jobs.jobs import Job


class WebhookEvent(StrEnum):
    """What a webhook can be told."""

    succeeded = "job.succeeded"
    failed = "job.failed"
    cancelled = "job.cancelled"


class CreateWebhook(Request):
    """A request to be told of the ends of jobs."""

    url: str = Field(min_length=1, max_length=2000, description="Address that receives the POST requests.")
    events: list[WebhookEvent] = Field(
        default_factory=lambda: list(WebhookEvent), min_length=1, description="What to tell; by default, all."
    )
    name: Label | None = Field(default=None, description="A name to recognise the webhook by.")


class Webhook(Response):
    """An address that is told of the ends of its owner's jobs."""

    id: str
    owner: Owner = DEFAULT_OWNER
    url: str
    events: list[WebhookEvent]
    name: str | None = None
    created_at: Time
    disabled_at: Time | None = Field(default=None, description="Since when nothing is sent to it.")
    disabled_reason: str | None = Field(default=None, description="Why nothing is sent to it.")


class WebhookWithSecret(Webhook):
    """A webhook with its secret, which is shown when it is made or changed, and never again."""

    secret: str = Field(description="Key of the signatures: `whsec_` and base64.")


class WebhookList(Response):
    """The webhooks of an owner, oldest first."""

    webhooks: list[Webhook]


class DeliveryState(StrEnum):
    """Where a delivery stands."""

    pending = "pending"
    delivered = "delivered"
    failed = "failed"


class DeliveryAttempt(Response):
    """One request to the address of a webhook."""

    at: Time
    seconds: float = Field(ge=0, description="How long it took.")
    status: int | None = Field(default=None, description="HTTP status of the answer, if there was one.")
    answer: str | None = Field(default=None, description="The beginning of the answer's body.")
    error: str | None = Field(default=None, description="Why there was no answer.")


class Delivery(Response):
    """One event for one webhook, and every attempt to deliver it."""

    id: str
    webhook: str
    event: WebhookEvent
    job: str = Field(description="Id of the job.")
    message: str = Field(description="The header `webhook-id`, the same in each attempt.")
    state: DeliveryState
    created_at: Time
    next_at: Time | None = Field(default=None, description="When the next attempt is due.")
    attempts: list[DeliveryAttempt] = Field(default_factory=list)
    reason: str | None = Field(default=None, description="Why it failed for good.")


class DeliveryList(Response):
    """The deliveries of a webhook, newest first."""

    deliveries: list[Delivery]


class WebhookPayload(Response):
    """The body of a webhook."""

    type: WebhookEvent
    timestamp: Time = Field(description="When the job ended.")
    data: Job
