"""Sends the deliveries of webhooks, signed by the Standard Webhooks specification, and repeats those that fail.

Every API process runs one loop. Pending deliveries are marked in storage by the time of their next attempt, and a lease
in Redis lets one process at a time make an attempt. If Redis is lost in that moment, a delivery may be sent twice, with
the same `webhook-id`; none is lost.

Owners take turns, and a delivery ends with its webhook.
"""

import asyncio
import random
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime, timedelta

import redis
import structlog
from starlette.concurrency import run_in_threadpool

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import StorageError
from splatmill.schema import DeliveryAttempt, DeliveryState, format_duration
from splatmill.schema.headers import read_retry_after
from splatmill.sdk.webhook_signature import sign
from splatmill_server.base import cancelling
from splatmill_server.base.leases import lease
from splatmill_server.base.metrics import Metrics
from splatmill_server.base.outgoing import Outgoing, OutgoingError
from splatmill_server.base.turns import Turns
from splatmill_server.webhooks import DeliveryRecord, WebhookRecord, Webhooks, mark_of

log = structlog.get_logger()

PAUSES = (5, 300, 1800, 7200, 18000, 36000, 50400, 72000, 86400)
"""Seconds after each failed attempt: ten attempts in three days, as the specification proposes."""

JITTER = 0.1
"""Largest relative change of a pause, so that the attempts for many jobs spread."""

ANSWER_SECONDS = 20.0
"""Seconds for an attempt in all."""

MAX_ANSWER = 500
"""Bytes of an answer that are kept in the log."""

LONGEST_RETRY_AFTER = 86400
"""Seconds of the header Retry-After that are followed."""

_LOOK_SECONDS = 5.0
"""Seconds between two looks for deliveries that are due. Each is a request to a bucket."""

_OLD_SECONDS = 3600.0
"""Seconds between two looks for old records of deliveries."""

_CONCURRENT = 16
_CONCURRENT_OWNER = 4
_CONCURRENT_EACH = 2
"""Attempts that one process makes at once, in all, of one owner and for one webhook: a slow one must not hold up the
others."""


class Deliveries:
    """The loop that sends."""

    def __init__(
        self, connection: redis.Redis, webhooks: Webhooks, outgoing: Outgoing, metrics: Metrics
    ) -> None:
        self.connection = connection
        self.webhooks = webhooks
        self.storage = webhooks.storage
        self.outgoing = outgoing
        self.metrics = metrics
        self._turns = Turns(_CONCURRENT, _CONCURRENT_OWNER)
        self._loop: asyncio.AbstractEventLoop | None = None
        # By ids of webhook and delivery, and the owners by id of a webhook.
        self._running: dict[tuple[str, str], asyncio.Task[None]] = {}
        self._owners: dict[str, str] = {}
        webhooks.on_delete.append(self._forget)
        webhooks.on_mark.append(self.wake)
        self._looked_at = float("-inf")
        self._due_at = float("inf")
        """Time, in seconds since the epoch, at which the first delivery is due that was not due at the last look."""
        self._wake = asyncio.Event()

    def wake(self) -> None:
        """Look for deliveries now. Any thread may call."""
        self._call(self._wake.set)

    def _call(self, function: Callable[..., None], *arguments: object) -> None:
        """Call a function in the loop that sends, if it runs."""
        if self._loop is not None:
            with suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(function, *arguments)

    def _forget(self, webhook_id: str) -> None:
        """End the attempts for a webhook that was deleted; those of other processes end within ANSWER_SECONDS.

        Any thread may call.
        """
        self._call(self._cancel, webhook_id)

    def _cancel(self, webhook_id: str) -> None:
        for key, task in self._running.items():
            if key[0] == webhook_id:
                task.cancel()

    async def run(self) -> None:
        """Send what is due until this task is cancelled."""
        self._loop = asyncio.get_running_loop()
        try:
            while True:
                self._wake.clear()
                try:
                    await self._look()
                except (StorageError, redis.RedisError) as error:
                    log.warning("deliveries cannot be looked for", error=str(error))
                except Exception:
                    log.exception("deliveries cannot be looked for")
                pause = min(_LOOK_SECONDS, max(0.0, self._due_at - time.time()))
                with suppress(TimeoutError):
                    async with asyncio.timeout(pause):
                        await self._wake.wait()
        finally:
            await cancelling.end(*self._running.values())

    async def _look(self) -> None:
        self._due_at = float("inf")
        if time.monotonic() - self._looked_at >= _OLD_SECONDS:
            self._looked_at = time.monotonic()
            await run_in_threadpool(self.webhooks.delete_old)
        marks = await run_in_threadpool(lambda: list(self.storage.entries(layout.due_deliveries())))
        self.metrics.webhooks_waiting.set(len(marks))
        waiting: dict[tuple[str, str], str] = {}
        of_webhook = Counter(webhook_id for webhook_id, _ in self._running)
        for entry in marks:  # sorted by the time at which they are due
            due, _, rest = entry.path.rsplit("/", 1)[-1].partition(".")
            webhook_id, _, delivery_id = rest.partition(".")
            key = (webhook_id, delivery_id)
            if not (due.isdigit() and layout.is_id(webhook_id) and layout.is_id(delivery_id)):
                continue
            if int(due) > time.time():
                self._due_at = int(due)
                break
            if key not in self._running and key not in waiting and of_webhook[webhook_id] < _CONCURRENT_EACH:
                of_webhook[webhook_id] += 1
                waiting[key] = entry.path
        await run_in_threadpool(self._read_owners, {webhook_id for webhook_id, _ in waiting})
        working = [self._owners.get(webhook_id, "") for webhook_id, _ in self._running]
        lines = [(self._owners.get(key[0], ""), key) for key in waiting if key not in self._running]
        for key in self._turns.choose(working, lines):
            self._running[key] = asyncio.create_task(self._work(key, waiting[key]))

    def _read_owners(self, waiting: set[str]) -> None:
        """Note the owners of the webhooks with deliveries that wait. One that was deleted has none."""
        running = {webhook_id for webhook_id, _ in [*self._running]}
        self._owners = {name: owner for name, owner in self._owners.items() if name in waiting | running}
        for webhook_id in waiting - self._owners.keys():
            webhook = self.webhooks.get_or_none(webhook_id)
            self._owners[webhook_id] = webhook.owner if webhook is not None else ""

    async def _work(self, key: tuple[str, str], mark: str) -> None:
        ended = True
        try:
            async with lease(self.connection, "delivery", ".".join(key)) as mine:
                if mine:
                    await self._attempt(key, mark)
                ended = mine
        except (StorageError, redis.RedisError) as error:
            ended = False
            log.warning("a delivery waits", webhook=key[0], delivery=key[1], error=str(error))
        except Exception:
            ended = False
            log.exception("a delivery waits", webhook=key[0], delivery=key[1])
        finally:
            self._running.pop(key, None)
            if ended:
                self.wake()  # for the next one that waits

    async def _attempt(self, key: tuple[str, str], mark: str) -> None:
        """Make the attempt that a mark announces, unless another process has made it, and remove the mark."""
        webhook = await run_in_threadpool(self.webhooks.get_or_none, key[0])
        delivery = await run_in_threadpool(self.webhooks.get_delivery, *key)
        if webhook is not None and delivery is not None and delivery.state is DeliveryState.pending:
            assert delivery.next_at is not None
            if delivery.next_at <= datetime.now(UTC):
                delivery = _counted(delivery)
                # Before it is sent: an attempt that cannot be counted is not made, or it would be made for ever.
                await run_in_threadpool(self.webhooks.save_delivery, delivery)
                delivery = await self._send(webhook, delivery)
                await run_in_threadpool(self.webhooks.save_delivery, delivery)
                result = "retried" if delivery.state is DeliveryState.pending else delivery.state.value
                self.metrics.webhook_attempts.labels(result).inc()
            if delivery.state is DeliveryState.pending:
                await run_in_threadpool(self.webhooks.mark, delivery)
                if mark == mark_of(delivery):
                    return
        await run_in_threadpool(self.storage.delete, mark)

    async def _send(self, webhook: WebhookRecord, delivery: DeliveryRecord) -> DeliveryRecord:
        """Return a counted delivery after its attempt. A webhook that refuses for good is disabled."""
        if webhook.disabled_at is not None:
            return _failed(delivery, "The webhook is disabled.")
        begun, at, body = time.monotonic(), datetime.now(UTC), delivery.body.encode()
        status, answer, failure, retry_after = None, None, None, 0.0
        try:
            async with (
                asyncio.timeout(ANSWER_SECONDS),
                self.outgoing.request(
                    "POST",
                    webhook.url,
                    headers=_headers(webhook, delivery, int(at.timestamp()), body),
                    body=body,
                    read_seconds=ANSWER_SECONDS,
                ) as reply,
            ):
                status = reply.status
                retry_after = read_retry_after(reply.headers.get("retry-after")) or 0.0
                answer = (await reply.beginning(MAX_ANSWER)).decode("utf-8", "replace")
        except TimeoutError:
            failure = f"There was no whole answer within {ANSWER_SECONDS:.0f} seconds."
        except OutgoingError as error:
            failure = str(error)
        except Exception as error:
            log.exception("an attempt ended unexpectedly", webhook=webhook.id, delivery=delivery.id)
            failure = f"The attempt ended in an unexpected error ({type(error).__name__})."
        made = DeliveryAttempt(
            at=at,
            seconds=round(time.monotonic() - begun, 3),
            status=status,
            answer=answer or None,
            error=failure,
        )
        delivery = delivery.model_copy(update={"attempts": [*delivery.attempts, made]})
        if status is not None and 200 <= status < 300:
            return delivery.model_copy(update={"state": DeliveryState.delivered, "next_at": None})
        if status == 410:
            await run_in_threadpool(self.webhooks.disable, webhook.id, "The address answered 410 (Gone).")
            return _failed(delivery, "The address answered 410 (Gone).")
        if delivery.tries > len(PAUSES):
            since = format_duration((at - delivery.created_at).total_seconds())
            reason = f"{delivery.tries} attempts to deliver {delivery.id} failed in {since}, the last one because: "
            reason += failure or f"the answer had the status {status}."
            await run_in_threadpool(self.webhooks.disable, webhook.id, reason)
            return _failed(delivery, reason)
        pause = max(_pause(delivery.tries), min(retry_after, LONGEST_RETRY_AFTER))
        return delivery.model_copy(update={"next_at": datetime.now(UTC) + timedelta(seconds=pause)})


def _counted(delivery: DeliveryRecord) -> DeliveryRecord:
    """Return the delivery with one attempt more, and the time of the next one if nothing more becomes known of this."""
    tries = delivery.tries + 1
    return delivery.model_copy(
        update={"tries": tries, "next_at": datetime.now(UTC) + timedelta(seconds=_pause(tries))}
    )


def _pause(tries: int) -> float:
    """Return the seconds after this many attempts."""
    return PAUSES[min(tries, len(PAUSES)) - 1] * random.uniform(1 - JITTER, 1 + JITTER)


def _headers(webhook: WebhookRecord, delivery: DeliveryRecord, timestamp: int, body: bytes) -> dict[str, str]:
    signatures = [sign(secret, delivery.message, timestamp, body) for secret in webhook.valid_secrets()]
    return {
        "Content-Type": "application/json",
        "webhook-id": delivery.message,
        "webhook-timestamp": str(timestamp),
        "webhook-signature": " ".join(signatures),
    }


def _failed(delivery: DeliveryRecord, reason: str) -> DeliveryRecord:
    return delivery.model_copy(update={"state": DeliveryState.failed, "next_at": None, "reason": reason})
