"""One reader for all who follow events on this process: it reads the streams of the followed jobs and passes them on.

A follower reads what came before by itself, once, and then waits here. It holds no connection to Redis: the reader
holds one, whatever the number of followers and jobs, and decodes each event once.
"""

import asyncio
import heapq
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import redis
from redis.asyncio import Redis as AsyncRedis

from splatmill.backplane import events, keys
from splatmill.backplane.events import StoredEvent

BLOCK_MS = 250
"""Milliseconds that the reader waits for new entries, after which it reads the rows again and sees who else follows."""

_READS = 16
"""Number of followers that read what came before at once."""

_LONGEST_QUEUE = 200
"""Number of batches that wait for a slow client. With more, it reads from Redis what it has missed."""

Row = Mapping[bytes, bytes]
"""The reply to HGETALL of a job's row; empty if there is none."""


@dataclass(frozen=True)
class Batch:
    """What was read of a job at once: its row, and after it the new events.

    found: the events in the order of time, each with the number of its stream in `events.BOUNDS`.
    end: the last entry of each stream.
    """

    row: Row
    found: Sequence[tuple[StoredEvent, int]]
    end: Sequence[str]


@dataclass
class _Followed:
    """A job that is followed.

    entries: the last entry that the reader has read of each stream; None until a follower has read what came before.
    """

    subscriptions: set["Subscription"] = field(default_factory=set)
    entries: list[str] | None = None
    row: Row | None = None


class Subscription:
    """A follower's place in the feed."""

    def __init__(self, job_id: str) -> None:
        self.job_id = job_id
        self._batches: deque[Batch] = deque()
        self._came = asyncio.Event()
        self._error: redis.RedisError | None = None
        self.missed = False
        """Whether batches were dropped, because they were not taken for too long."""

    def put(self, batch: Batch) -> None:
        """Add a batch for the follower."""
        if len(self._batches) >= _LONGEST_QUEUE:
            self._batches.clear()
            self.missed = True
        self._batches.append(batch)
        self._came.set()

    def fail(self, error: redis.RedisError) -> None:
        """Let the follower know that Redis cannot be read."""
        self._error = error
        self._came.set()

    async def next(self, seconds: float) -> Batch | None:
        """Return the next batch, or None if there is none after this time. Raises redis.RedisError."""
        if not self._batches and self._error is None:
            with suppress(TimeoutError):
                await asyncio.wait_for(self._came.wait(), seconds)
        self._came.clear()
        if self._error is not None:
            raise self._error
        return self._batches.popleft() if self._batches else None


class Feed:
    """The reader of one process. It runs while somebody follows a job."""

    def __init__(self, connection: AsyncRedis) -> None:
        self._redis = connection
        self._followed: dict[str, _Followed] = {}
        self._reading: asyncio.Task[None] | None = None
        self._turn = asyncio.Semaphore(_READS)

    @property
    def followers(self) -> int:
        """Number of those who follow jobs."""
        return sum(len(job.subscriptions) for job in self._followed.values())

    def subscribe(self, job_id: str) -> Subscription:
        """Return a new place in the feed of a job. It must be closed."""
        subscription = Subscription(job_id)
        self._followed.setdefault(job_id, _Followed()).subscriptions.add(subscription)
        return subscription

    def close(self, subscription: Subscription) -> None:
        """End a subscription."""
        job = self._followed.get(subscription.job_id)
        if job is not None:
            job.subscriptions.discard(subscription)
            if not job.subscriptions:
                del self._followed[subscription.job_id]

    async def stop(self) -> None:
        """End the reader."""
        if (reading := self._reading) is not None:
            reading.cancel()
            await asyncio.gather(reading, return_exceptions=True)

    async def catch_up(self, subscription: Subscription, entries: Sequence[str]) -> tuple[Batch, bool]:
        """Read all events of a job after these entries. Return them, and whether those that follow come by the feed.

        Raises redis.RedisError.
        """
        job = self._followed[subscription.job_id]
        # What the reader has begun to read before this is either in this reply or comes by the feed.
        begun = job.entries is not None
        async with self._turn:
            rows, positions = await self._read([subscription.job_id], {subscription.job_id: entries}, None)
        batch = _batch(subscription.job_id, rows[0], positions, entries)
        if not begun and job.entries is None:
            job.entries, begun = list(batch.end), True
        if begun and self._reading is None:
            self._reading = asyncio.create_task(self._run())
        return batch, begun

    async def _run(self) -> None:
        try:
            while self._followed:
                await self._pass_on()
        except redis.RedisError as error:
            for job in self._followed.values():
                for subscription in job.subscriptions:
                    subscription.fail(error)
        finally:
            self._reading = None

    async def _pass_on(self) -> None:
        """Read what is new of all followed jobs, and pass it on."""
        read = {name: job.entries for name, job in self._followed.items() if job.entries is not None}
        if not read:
            await asyncio.sleep(BLOCK_MS / 1000)
            return
        rows, reply = await self._read(list(read), read, BLOCK_MS)
        for (name, entries), row in zip(read.items(), rows, strict=True):
            job = self._followed.get(name)
            if job is None or job.entries is not entries:
                continue  # everybody has left meanwhile
            batch = _batch(name, row, reply, entries)
            if batch.found or list(batch.end) != list(entries) or row != job.row:
                job.entries, job.row = list(batch.end), row
                for subscription in job.subscriptions:
                    subscription.put(batch)

    async def _read(
        self, job_ids: Sequence[str], entries: Mapping[str, Sequence[str]], block: int | None
    ) -> tuple[list[Row], dict[str, Any]]:
        """Return the rows of jobs and, read after them, the new entries by stream."""
        pipe = self._redis.pipeline(transaction=False)
        for job_id in job_ids:
            pipe.hgetall(keys.job(job_id))
        rows = await pipe.execute()
        positions: Any = {
            stream(job_id): entry
            for job_id in job_ids
            for stream, entry in zip(events.BOUNDS, entries[job_id], strict=True)
        }
        reply: Any = await self._redis.xread(positions, block=block)
        return rows, {name.decode(): found for name, found in reply or []}


def _batch(job_id: str, row: Row, reply: Mapping[str, Any], entries: Sequence[str]) -> Batch:
    """Return what a reply has of a job, read after these entries."""
    streams = [stream(job_id) for stream in events.BOUNDS]
    end = [
        reply[name][-1][0].decode() if reply.get(name) else entry
        for name, entry in zip(streams, entries, strict=True)
    ]
    read = [
        [(stored, number) for stored in events.decode(reply.get(name, []), name)]
        for number, name in enumerate(streams)
    ]
    # The order within each stream is kept.
    return Batch(row, list(heapq.merge(*read, key=lambda found: events.time_order(found[0]))), end)
