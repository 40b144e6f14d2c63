"""Webhooks: their records, and the deliveries that the end of a job makes. `background.deliveries` sends them.

Everything is in storage, so that nothing is skipped when a process or Redis is lost. A job that has ended leaves the
set of unfinished jobs only after its deliveries are recorded (`Jobs.on_end`), by whichever API process comes first: the
id of a delivery follows from the job and its generation, and only one process creates it.
"""

import base64
import hashlib
import math
import secrets
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta

import structlog

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.records import FORMAT, read_record
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import (
    CreateWebhook,
    Delivery,
    DeliveryState,
    Job,
    Response,
    Time,
    Webhook,
    WebhookEvent,
    WebhookPayload,
    WebhookWithSecret,
)
from splatmill.sdk.webhook_signature import SECRET_PREFIX
from splatmill_server.base.leases import exclusive
from splatmill_server.base.problems import ProblemError
from splatmill_server.jobs.records import Jobs

log = structlog.get_logger()

MAX_WEBHOOKS = 20
"""Webhooks of one owner."""

KEPT_DAYS = 30
"""Days for which the record of a delivery that is over is kept."""

GRACE = timedelta(hours=24)
"""Time for which a webhook is signed with the former secret too, after it got a new one."""


class Secret(Response):
    """A secret of a webhook. `until` is set for a former one."""

    value: str
    until: Time | None = None


class WebhookRecord(Webhook):
    """A webhook as it is stored. The newest secret is the first one."""

    format: int = FORMAT
    secrets: list[Secret]

    def public(self) -> Webhook:
        """Return the webhook without its secrets."""
        return Webhook.model_validate(self.model_dump())

    def valid_secrets(self) -> list[str]:
        """Return the secrets to sign with now."""
        now = datetime.now(UTC)
        return [secret.value for secret in self.secrets if secret.until is None or secret.until > now]


class DeliveryRecord(Delivery):
    """A delivery as it is stored.

    body: what is sent.
    tries: attempts since the delivery was made or repeated by hand; the pause before the next one follows from it.
    """

    format: int = FORMAT
    body: str
    tries: int = 0

    def public(self) -> Delivery:
        """Return the delivery without its body."""
        return Delivery.model_validate(self.model_dump())


class Webhooks:
    """All operations on webhooks but sending. Methods raise ProblemError, StorageError and redis.RedisError.

    A record is read, changed and written under a lease, so that of two changes at once neither is lost.
    """

    def __init__(self, storage: Storage, jobs: Jobs) -> None:
        self.storage = storage
        self.jobs = jobs
        self.connection = jobs.connection
        self.on_delete: list[Callable[[str], None]] = []
        """Called with the id of a webhook once its record is deleted."""
        self.on_mark: list[Callable[[], None]] = []
        """Called once a delivery is marked as due."""
        jobs.on_end.append(self.announce)

    def create(self, request: CreateWebhook, owner: str) -> WebhookWithSecret:
        """Create a webhook with a new secret. The caller has checked its address."""
        with exclusive(self.connection, "webhooks", owner):
            return self._create(request, owner)

    def _create(self, request: CreateWebhook, owner: str) -> WebhookWithSecret:
        if len(self.list(owner)) >= MAX_WEBHOOKS:
            raise ProblemError(
                "too_many_requests",
                f"There are {MAX_WEBHOOKS} webhooks, and no more are accepted for one owner.",
                advice="Delete one that is not needed with DELETE /v1/webhooks/{id}.",
            )
        record = WebhookRecord(
            id=secrets.token_hex(8),
            owner=owner,
            url=request.url,
            events=[event for event in WebhookEvent if event in request.events],
            name=request.name,
            created_at=datetime.now(UTC),
            secrets=[_new_secret()],
        )
        self._write(record)
        return _with_secret(record)

    def list(self, owner: str | None) -> list[WebhookRecord]:
        """Return the webhooks of an owner, or of all (None), oldest first."""
        ids = self.storage.children(layout.webhooks())
        webhooks = [record for webhook_id in ids if (record := self.get_or_none(webhook_id)) is not None]
        mine = [record for record in webhooks if owner is None or record.owner == owner]
        return sorted(mine, key=lambda record: record.created_at)

    def get_or_none(self, webhook_id: str) -> WebhookRecord | None:
        """Return a webhook, or None if there is none, or none that can be read."""
        return read_record(self.storage, layout.webhook_record(webhook_id), WebhookRecord)

    def get(self, webhook_id: str) -> WebhookRecord:
        """Return a webhook. Raises a 404 problem."""
        webhook = self.get_or_none(webhook_id) if layout.is_id(webhook_id) else None
        if webhook is None:
            raise webhook_not_found(webhook_id)
        return webhook

    def delete(self, webhook_id: str) -> None:
        """Delete a webhook and the log of its deliveries. Those that are pending are not sent any more."""
        with self._changing(webhook_id):
            self.storage.delete(layout.webhook_record(webhook_id))
            for forget in self.on_delete:
                forget(webhook_id)
            self.storage.delete_prefix(layout.webhook(webhook_id))

    def rotate(self, webhook_id: str) -> WebhookWithSecret:
        """Give a webhook a new secret. For GRACE, each request carries a signature with the former one too."""
        with self._changing(webhook_id) as record:
            former = record.secrets[0].model_copy(update={"until": datetime.now(UTC) + GRACE})
            record = record.model_copy(update={"secrets": [_new_secret(), former]})
            self._write(record)
        return _with_secret(record)

    def enable(self, webhook_id: str) -> WebhookRecord:
        """Send to a disabled webhook again. Deliveries that have failed meanwhile can be repeated one by one."""
        with self._changing(webhook_id) as record:
            record = record.model_copy(update={"disabled_at": None, "disabled_reason": None})
            self._write(record)
        return record

    def disable(self, webhook_id: str, reason: str) -> None:
        """Send nothing to a webhook any more."""
        with exclusive(self.connection, "webhook", webhook_id):
            record = self.get_or_none(webhook_id)
            if record is not None and record.disabled_at is None:
                log.warning("webhook disabled", webhook=webhook_id, reason=reason)
                now = datetime.now(UTC)
                self._write(record.model_copy(update={"disabled_at": now, "disabled_reason": reason}))

    def list_deliveries(self, webhook_id: str) -> Sequence[Delivery]:
        """Return the deliveries of a webhook, newest first. Those that are over are kept for KEPT_DAYS."""
        entries = self.storage.entries(layout.deliveries(webhook_id))
        ids = [entry.path.rsplit("/", 1)[-1].removesuffix(".json") for entry in entries]
        deliveries = [
            record.public() for name in ids if (record := self.get_delivery(webhook_id, name)) is not None
        ]
        return sorted(deliveries, key=lambda record: record.created_at, reverse=True)

    def get_delivery(self, webhook_id: str, delivery_id: str) -> DeliveryRecord | None:
        """Return a delivery, or None if there is none, or none that can be read."""
        return read_record(self.storage, layout.delivery_record(webhook_id, delivery_id), DeliveryRecord)

    def repeat(self, webhook_id: str, delivery_id: str) -> Delivery:
        """Send a delivery that is over once more, with the same message id. Raises a 404 problem."""
        delivery = self.get_delivery(webhook_id, delivery_id) if layout.is_id(delivery_id) else None
        if delivery is not None and delivery.state is not DeliveryState.pending:
            with exclusive(self.connection, "delivery", f"{webhook_id}.{delivery_id}"):
                delivery = self._repeated(webhook_id, delivery_id)
        if delivery is None:
            raise ProblemError(
                "delivery_not_found",
                f"The webhook has no delivery {delivery_id[:80]!r}.",
                advice="List the deliveries with GET /v1/webhooks/{id}/deliveries.",
            )
        return delivery.public()

    def _repeated(self, webhook_id: str, delivery_id: str) -> DeliveryRecord | None:
        """Make a delivery that is over pending again, unless another request has."""
        delivery = self.get_delivery(webhook_id, delivery_id)
        if delivery is not None and delivery.state is not DeliveryState.pending:
            update = {"state": DeliveryState.pending, "next_at": _at_once(), "tries": 0, "reason": None}
            delivery = delivery.model_copy(update=update)
            self.save_delivery(delivery)
            self.mark(delivery)
        return delivery

    def save_delivery(self, record: DeliveryRecord) -> None:
        """Store a delivery, unless its webhook was deleted."""
        if self.storage.exists(layout.webhook_record(record.webhook)):
            path = layout.delivery_record(record.webhook, record.id)
            self.storage.put(path, record.model_dump_json(exclude_none=True).encode())

    def mark(self, record: DeliveryRecord) -> None:
        """Mark a pending delivery as due at its next time."""
        self.storage.put(mark_of(record), b"{}")
        for marked in self.on_mark:
            marked()

    def announce(self, job: Job, generation: int) -> None:
        """Record the deliveries of a job that has ended. Repeated calls for the same end have no further effect."""
        event = WebhookEvent(f"job.{job.state.value}")
        ended = job.finished_at or datetime.now(UTC)
        if ended < datetime.now(UTC) - timedelta(days=KEPT_DAYS):
            return  # the record of its delivery may be gone, and without it the end would be sent twice
        for webhook in self.list(job.owner):
            if event not in webhook.events or webhook.disabled_at is not None:
                continue
            if ended < webhook.created_at:
                continue
            delivery_id = hashlib.sha256(f"{webhook.id} {job.id} {generation}".encode()).hexdigest()[:24]
            known = self.get_delivery(webhook.id, delivery_id)
            if known is None:
                now = datetime.now(UTC)
                payload = WebhookPayload(type=event, timestamp=ended, data=job)
                known = DeliveryRecord(
                    id=delivery_id,
                    webhook=webhook.id,
                    event=event,
                    job=job.id,
                    message=f"msg_{delivery_id}",
                    state=DeliveryState.pending,
                    created_at=now,
                    next_at=_at_once(),
                    body=payload.model_dump_json(exclude_none=True),
                )
                path = layout.delivery_record(webhook.id, delivery_id)
                if not self.storage.put_new(path, known.model_dump_json(exclude_none=True).encode()):
                    known = (
                        self.get_delivery(webhook.id, delivery_id) or known
                    )  # another process has just made it
            if known.state is DeliveryState.pending and not known.attempts:
                self.mark(known)  # the process that made it may have died before it did

    def delete_old(self) -> int:
        """Delete the records of deliveries that were over KEPT_DAYS ago, and return their number."""
        before, deleted = time.time() - KEPT_DAYS * 86400, 0
        for webhook_id in self.storage.children(layout.webhooks()):
            for entry in self.storage.entries(layout.deliveries(webhook_id)):
                name = entry.path.rsplit("/", 1)[-1].removesuffix(".json")
                delivery = (
                    self.get_delivery(webhook_id, name) if entry.modified.timestamp() < before else None
                )
                if delivery is not None and delivery.state is not DeliveryState.pending:
                    self.storage.delete(entry.path)
                    deleted += 1
        return deleted

    @contextmanager
    def _changing(self, webhook_id: str) -> Iterator[WebhookRecord]:
        """Yield a webhook that is to be changed, and keep other changes away meanwhile. Raises a 404 problem."""
        self.get(webhook_id)
        with exclusive(self.connection, "webhook", webhook_id):
            yield self.get(webhook_id)

    def _write(self, record: WebhookRecord) -> None:
        path = layout.webhook_record(record.id)
        self.storage.put(path, record.model_dump_json(exclude_none=True).encode())


def _at_once() -> datetime:
    """Return the time of an attempt that is due now: a whole second, since marks are named by those."""
    return datetime.now(UTC).replace(microsecond=0)


def mark_of(record: DeliveryRecord) -> str:
    """Return the path of the mark of a pending delivery."""
    assert record.next_at is not None
    return layout.due_delivery(math.ceil(record.next_at.timestamp()), record.webhook, record.id)


def webhook_not_found(webhook_id: str) -> ProblemError:
    """Return the 404 problem for an id without a webhook."""
    return ProblemError(
        "webhook_not_found",
        f"There is no webhook {webhook_id[:80]!r}.",
        advice="List the webhooks with GET /v1/webhooks.",
    )


def _new_secret() -> Secret:
    return Secret(value=SECRET_PREFIX + base64.b64encode(secrets.token_bytes(32)).decode())


def _with_secret(record: WebhookRecord) -> WebhookWithSecret:
    return WebhookWithSecret(**record.public().model_dump(), secret=record.secrets[0].value)
