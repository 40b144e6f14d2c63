"""One reader for all who follow events on this process: it reads the streams of the followed jobs and passes them on.

A follower reads what came before by itself, once, and then waits here. It holds no connection to Redis: the reader
holds one, whatever the number of followers and jobs, and decodes each event once.

The reader's positions come from Redis alone. The position that a client sends bounds only what that client is sent.
"""

import asyncio
import heapq
import time
from collections import deque
from collections.abc import AsyncIterator, Iterable, Mapping, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

import redis
import structlog
from redis.asyncio import Redis as AsyncRedis

from splatmill.backplane import keys
from splatmill.backplane.jobs import events
from splatmill.backplane.jobs.events import START, StoredEvent, stream_order
from splatmill_server.base import cancelling

log = structlog.get_logger()

_ANSWER_SECONDS = 30.0
"""Seconds without an answer, after which Redis counts as lost: the connection may have broken without being closed. A
command may wait for a free connection for a part of them."""

BLOCK_MS = 250
"""Milliseconds that the reader waits for new entries, after which it reads the rows again and sees who else follows."""

_CHECK_SECONDS = 5.0
"""Seconds between two comparisons of the reader's positions with the ends of the streams."""

_READS = 16
"""Number of followers that read what came before at once."""

_LONGEST_QUEUE = 200
"""Number of batches that wait for a slow client. With more, it reads from Redis what it has missed."""

Row = Mapping[bytes, bytes]
"""The reply to HGETALL of a job's row; empty if there is none."""


@dataclass(frozen=True)
class Batch:
    """What was read of a job at once: its row, and after it the new events.

    events: those of the job in the order of time, each with the number of its stream in `events.BOUNDS`.
    end: the last entry of each stream.
    """

    row: Row
    events: Sequence[tuple[StoredEvent, int]]
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

    def __init__(self, job_id: str, owner: str) -> None:
        self.job_id = job_id
        self.owner = owner
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
                async with asyncio.timeout(seconds):
                    await self._came.wait()
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
        self._checked = time.monotonic()

    @property
    def followers(self) -> int:
        """Number of those who follow jobs."""
        return sum(len(job.subscriptions) for job in self._followed.values())

    def followers_of(self, owner: str) -> int:
        """Return the number of those among the followers who have this owner's keys."""
        places = (place for job in self._followed.values() for place in job.subscriptions)
        return sum(place.owner == owner for place in places)

    def subscribe(self, job_id: str, owner: str = "") -> Subscription:
        """Return a new place in the feed of a job, of a follower with a key of this owner. It must be closed."""
        subscription = Subscription(job_id, owner)
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
            await cancelling.end(reading)

    async def catch_up(self, subscription: Subscription, entries: Sequence[str]) -> tuple[Batch, bool]:
        """Read all events of a job after these entries. Return them, and whether those that follow come by the feed.

        Raises redis.RedisError.
        """
        name = subscription.job_id
        job = self._followed[name]
        # What the reader has begun to read before this is either in this reply or comes by the feed.
        begun = job.entries is not None
        async with self._turn:
            # Before the events: what is appended between the two replies comes after these ends.
            ends = None if begun else (await self._ends([name]))[name]
            rows, reply = await self._read([name], {name: entries}, None)
        if ends is not None and job.entries is None:
            job.entries, begun = _end(name, reply, ends), True
        if begun and self._reading is None:
            self._reading = asyncio.create_task(self._run())
        return _batch(name, rows[0], reply, entries), begun

    async def ends(self, job_id: str) -> list[str]:
        """Return the last entry of each stream of a job, or START. Raises redis.RedisError."""
        async with self._turn:
            return (await self._ends([job_id]))[job_id]

    async def _ends(self, job_ids: Sequence[str]) -> dict[str, list[str]]:
        pipe = self._redis.pipeline(transaction=False)
        for job_id in job_ids:
            for stream in events.BOUNDS:
                pipe.xrevrange(stream(job_id), count=1)
        async with answering():
            replies = await pipe.execute()
        last = iter([reply[0][0].decode() if reply else START for reply in replies])
        return {job_id: [next(last) for _ in events.BOUNDS] for job_id in job_ids}

    async def _run(self) -> None:
        try:
            while self._followed:
                await self._pass_on()
                if time.monotonic() - self._checked >= _CHECK_SECONDS:
                    await self._check()
                    self._checked = time.monotonic()
        except redis.RedisError as error:
            self._fail(self._followed.values(), error)
        except Exception as error:
            log.exception("the events of jobs cannot be read")
            self._fail(self._followed.values(), redis.RedisError(str(error)))
        finally:
            self._reading = None

    async def _check(self) -> None:
        """End the streams of jobs of which Redis has less than was read: it was restored, and its clock may be behind.

        Their new entries may come before the position of the reader, which would never read them.
        """
        read = {name: job.entries for name, job in self._followed.items() if job.entries is not None}
        ends = await self._ends(list(read)) if read else {}
        for name, entries in read.items():
            job = self._followed.get(name)
            if job is not None and job.entries is entries and any(map(is_beyond, entries, ends[name])):
                self._fail([job], redis.RedisError("Redis has lost entries of a stream."))

    def _fail(self, jobs: Iterable[_Followed], error: redis.RedisError) -> None:
        """End the streams of all who follow these jobs; clients come back, and the reader then begins anew."""
        for job in jobs:
            job.entries = job.row = None
            for subscription in job.subscriptions:
                subscription.fail(error)

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
            if batch.events or list(batch.end) != list(entries) or row != job.row:
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
        async with answering():
            rows = await pipe.execute()
        positions: Any = {
            stream(job_id): entry
            for job_id in job_ids
            for stream, entry in zip(events.BOUNDS, entries[job_id], strict=True)
        }
        async with answering():
            reply: Any = await self._redis.xread(positions, block=block)
        return rows, {name.decode(): new_entries for name, new_entries in reply or []}


@asynccontextmanager
async def answering(seconds: float | None = None) -> AsyncIterator[None]:
    """Bound a request to Redis, whose client has no timeout. Raises redis.TimeoutError after `seconds`, by default
    _ANSWER_SECONDS.
    """
    seconds = _ANSWER_SECONDS if seconds is None else seconds
    try:
        async with asyncio.timeout(seconds):
            yield
    except TimeoutError:
        raise redis.TimeoutError(f"Redis has not answered for {seconds:g} seconds.") from None


def is_beyond(entry: str, end: str) -> bool:
    """Return whether a position lies after the last entry of its stream; not if the stream has no entries."""
    return end != START and stream_order(entry) > stream_order(end)


def _batch(job_id: str, row: Row, reply: Mapping[str, Any], entries: Sequence[str]) -> Batch:
    """Return what a reply has of a job, read after these entries."""
    read = [
        [(stored, number) for stored in events.decode(reply.get(name, []), name)]
        for number, name in enumerate(stream(job_id) for stream in events.BOUNDS)
    ]
    # The order within each stream is kept.
    merged = list(heapq.merge(*read, key=lambda merged: events.time_order(merged[0])))
    return Batch(row, merged, _end(job_id, reply, entries))


def _end(job_id: str, reply: Mapping[str, Any], entries: Sequence[str]) -> list[str]:
    """Return the last entry of each stream in a reply; where it has none, the one in `entries`."""
    names = [stream(job_id) for stream in events.BOUNDS]
    return [
        reply[name][-1][0].decode() if reply.get(name) else entry
        for name, entry in zip(names, entries, strict=True)
    ]
