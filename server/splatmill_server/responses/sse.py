"""The events of a job as server-sent events: its streams and the row, merged into one sequence.

The id of an event names a position in each stream, from which a client can resume after a lost connection. The events
that follow from the row (queued, and the server's verdict) are state events of attempt 0; there are up to two of them
in each generation of a job.
"""

import asyncio
import re
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, cast

import redis
from prometheus_client import Gauge

from splatmill.backplane import keys
from splatmill.backplane.jobs import events
from splatmill.backplane.jobs.events import START, stream_order
from splatmill.backplane.jobs.fold import Fold
from splatmill.backplane.jobs.row import JobRow
from splatmill.backplane.storage.records import UnreadableRecord, warn
from splatmill.schema import EventRecord, Job, JobState, StateEvent, Time
from splatmill_server.base import cancelling
from splatmill_server.base.feed import Batch, Row, answering, is_beyond
from splatmill_server.service import Service

_ENTRY = r"\d{1,19}-\d{1,19}"
_POSITION = re.compile(rf"({_ENTRY})_({_ENTRY})_(\d{{1,9}})((?:_{_ENTRY}){{3}})")
_LINE_ENDS = {0x85: "\\u0085", 0x2028: "\\u2028", 0x2029: "\\u2029"}
_LOOK_SECONDS = 1.0
"""Seconds without an event after which a follower looks whether it may go on."""


@dataclass
class Position:
    """A position in the events of a job.

    entries: id of the last entry read from each stream of a job, in the order of `events.BOUNDS`.
    row_events: number of the last event that follows from the row.

    As text, it is `<states>_<progress>_<row events>_<log>_<warnings>_<curve>`.
    """

    entries: list[str] = field(default_factory=lambda: [START] * len(events.BOUNDS))
    row_events: int = 0

    @classmethod
    def parse(cls, text: str) -> "Position | None":
        """Return the position in a `Last-Event-ID`, or None for any other text."""
        match = _POSITION.fullmatch(text)
        if match is None:
            return None
        states, progress, row_events, others = match.groups()
        return cls([states, progress, *others[1:].split("_")], int(row_events))

    @property
    def states(self) -> str:
        """Id of the last entry read from the states stream."""
        return self.entries[0]

    def __str__(self) -> str:
        states, progress, *others = self.entries
        return "_".join([states, progress, str(self.row_events), *others])


class Follower:
    """Reads the events of a job from a position on. Raises redis.RedisError if Redis cannot be reached.

    permitted: whether the reader may go on; asked again and again, because keys can be revoked.
    owner: whose key the reader has.
    """

    def __init__(
        self,
        service: Service,
        job_id: str,
        position: Position,
        permitted: Callable[[], Awaitable[bool]],
        owner: str,
    ) -> None:
        self.permitted = permitted
        self.owner = owner
        self.redis = service.redis_async
        self.feed = service.feed
        self.closing = service.closing
        self.job_id = job_id
        self.position = position

    async def begin(self, row: JobRow) -> bool:
        """Apply the events that the client has already seen; return False if the job had ended by then.

        A position beyond the events that the job has was not issued by this Redis, or Redis was restored from an older
        copy. Which events of a running job the client has is then unknown, so all are sent.
        """
        self.fold = Fold(row)
        self._stored: Row = {}
        if self.position == Position():
            return True
        ends = await self.feed.ends(self.job_id)
        beyond = any(map(is_beyond, self.position.entries, ends))
        beyond |= self.position.row_events > 2 * row.generation + 1
        # A stream without entries was deleted when the job had ended; what a restart appends is new to everybody.
        known = zip(self.position.entries, ends, strict=True)
        self.position.entries = [min(pair, key=stream_order) for pair in known]
        if self.position.states != START:
            async with answering():
                states = await cast(
                    Any, self.redis.xrange(keys.states(self.job_id), max=self.position.states)
                )
            for stored in events.decode(states, keys.states(self.job_id)):
                self.fold.apply(stored)
        if self.position.row_events > 2 * row.generation:
            self.fold.close()
        if self.fold.final:
            return False
        if beyond:
            self.position, self.fold = Position(), Fold(row)
        return True

    async def records(self) -> AsyncIterator[EventRecord]:
        """Yield the events that count, until the job ends, the server stops or the reader may not go on."""
        subscription = self.feed.subscribe(self.job_id, self.owner)
        try:
            live = False
            while not self.closing.is_set() and await self.permitted():
                if live and not subscription.missed:
                    batch = await subscription.next(_LOOK_SECONDS)
                    if batch is None:
                        continue
                else:
                    subscription.missed = False
                    batch, live = await self.feed.catch_up(subscription, self.position.entries)
                for record in self._told(batch):
                    yield record
                if self._over:
                    return
        finally:
            self.feed.close(subscription)

    def _told(self, batch: Batch) -> Iterator[EventRecord]:
        """Yield what counts of a batch and was not told before, and note whether anything can follow."""
        self._over = True
        try:
            row = self.fold.row if batch.row == self._stored else JobRow.of(batch.row)
        except UnreadableRecord as error:
            warn(f"the events of job {self.job_id} end", str(error))
            return
        if row is None:
            return  # the job was deleted
        self._stored = batch.row
        if row.generation != self.fold.row.generation:
            self.fold = Fold(row)
        self.fold.row = row
        if self.position.row_events < 2 * row.generation:
            yield self._row_event(2 * row.generation, row.queued_at, StateEvent(state=JobState.queued))
        for stored, stream in batch.events:
            if stored.order <= stream_order(self.position.entries[stream]):
                continue  # read before it came by the feed
            self.position.entries[stream] = stored.id
            if self.fold.apply(stored):
                yield stored.record(str(self.position))
        # Also after entries that are not readable.
        self.position.entries = [
            max(known, read, key=stream_order)
            for known, read in zip(self.position.entries, batch.end, strict=True)
        ]
        if self.fold.final:
            return
        # The row was read before the events, so that all up to its verdict were among them.
        if (verdict := row.verdict) is not None:
            event = StateEvent(state=JobState(verdict.state), problem=verdict.problem)
            yield self._row_event(2 * row.generation + 1, verdict.at, event)
            return
        self._over = False

    def _row_event(self, number: int, at: Time, event: StateEvent) -> EventRecord:
        self.position.row_events = number
        return EventRecord(id=str(self.position), attempt=0, at=at, event=event)


async def event_stream(follower: Follower, heartbeat: float, open_streams: Gauge) -> AsyncIterator[bytes]:
    """Yield the body of a `text/event-stream`, with a comment after every `heartbeat` seconds without an event."""
    records = follower.records()
    pending: asyncio.Future[EventRecord] | None = None
    open_streams.inc()
    try:
        yield b"retry: 2000\n\n"
        while True:
            pending = pending or asyncio.ensure_future(cast(Any, anext(records)))
            done, _ = await asyncio.wait({pending}, timeout=heartbeat)
            if not done:
                yield b": still here\n\n"
                continue
            finished, pending = pending, None
            try:
                record = finished.result()
            except (StopAsyncIteration, redis.RedisError):
                return  # the job has ended, or Redis cannot be reached and the client will reconnect
            yield encode(record)
    finally:
        open_streams.dec()
        if pending is not None:
            await cancelling.end(pending)


def encode(record: EventRecord) -> bytes:
    """Encode a message. Line separators such as U+2028 are escaped, because some parsers split lines at them."""
    data = record.model_dump_json(exclude_none=True).translate(_LINE_ENDS)
    return f"id: {record.id}\nevent: {record.event.type}\ndata: {data}\n\n".encode()


async def stored_stream(job: Job) -> AsyncIterator[bytes]:
    """Yield the end of a job that Redis has lost, which is all that storage knows of its events."""
    event = StateEvent(state=job.state, problem=job.problem)
    at = job.finished_at or job.created_at
    yield encode(EventRecord(id=str(Position()), attempt=job.attempt, at=at, event=event))
