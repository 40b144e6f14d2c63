"""A job's events as server-sent events: two streams and the row, as one sequence with ids that survive reconnects.

An id is `<states position>_<progress position>_<told>`: all three are needed to go on exactly where a lost
connection stopped. What the server itself has to say (queued, and its verdict) appears as state events of attempt 0;
`told` counts these, two for each generation of the job.
"""

import asyncio
import re
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Any, cast

import redis
from prometheus_client import Gauge

from splatmill.backplane import events, keys
from splatmill.backplane.events import START, Stored, stream_order
from splatmill.backplane.fold import Fold
from splatmill.backplane.row import JobRow
from splatmill.schema import EventRecord, Job, JobState, StateEvent, Time
from splatmill_server.service import Service

_CURSOR = re.compile(r"(\d{1,19}-\d{1,19})_(\d{1,19}-\d{1,19})_(\d{1,9})")
_LINE_ENDS = {0x85: "\\u0085", 0x2028: "\\u2028", 0x2029: "\\u2029"}
_BLOCK_MS = 500
"""How long one read waits; also how late a change of the row can be noticed."""


@dataclass
class Cursor:
    """A position in everything that is told about a job."""

    states: str = START
    progress: str = START
    told: int = 0

    @classmethod
    def parse(cls, text: str) -> "Cursor | None":
        """The cursor in a `Last-Event-ID`, None for a text that is none of ours."""
        match = _CURSOR.fullmatch(text)
        return cls(match[1], match[2], int(match[3])) if match else None

    def __str__(self) -> str:
        return f"{self.states}_{self.progress}_{self.told}"


class Follower:
    """Follows one job from a cursor on. Raises redis.RedisError when Redis goes away."""

    def __init__(self, service: Service, job_id: str, cursor: Cursor) -> None:
        self.redis = service.redis_async
        self.closing = service.closing
        self.job_id = job_id
        self.cursor = cursor

    async def begin(self, row: JobRow) -> bool:
        """Take what the client has seen already into account; False when nothing is left to tell."""
        self.fold = Fold(row)
        seen = await self._reply(self.redis.xrange(keys.states(self.job_id), max=self.cursor.states))
        for stored in events.decode(seen):
            self.fold.apply(stored)
        if self.cursor.told > 2 * row.generation:
            self.fold.close()
        return not self.fold.final

    async def run(self) -> AsyncIterator[EventRecord]:
        """Each event that counts, until the job's end or the server's."""
        while not self.closing.is_set():
            row = JobRow.of(await self._reply(self.redis.hgetall(keys.job(self.job_id))))
            if row is None:
                return  # Deleted.
            if row.generation != self.fold.row.generation:
                self.fold = Fold(row)
            self.fold.row = row
            if self.cursor.told < 2 * row.generation:
                yield self._own(2 * row.generation, row.queued_at, StateEvent(state=JobState.queued))
            for stored, is_state in await self._read():
                if is_state:
                    self.cursor.states = stored.id
                else:
                    self.cursor.progress = stored.id
                if self.fold.apply(stored):
                    yield stored.record(str(self.cursor))
            if self.fold.final:
                return
            verdict = row.verdict
            if verdict is not None and stream_order(self.cursor.states) >= stream_order(verdict.after):
                event = StateEvent(state=JobState(verdict.state), problem=verdict.problem)
                yield self._own(2 * row.generation + 1, verdict.at, event)
                return

    def _own(self, told: int, at: Time, event: StateEvent) -> EventRecord:
        self.cursor.told = told
        return EventRecord(id=str(self.cursor), attempt=0, at=at, event=event)

    async def _read(self) -> list[tuple[Stored, bool]]:
        """New entries of both streams in the order of Redis's clock; waits a little when there are none."""
        states, progress = keys.states(self.job_id), keys.progress(self.job_id)
        positions: Any = {states: self.cursor.states, progress: self.cursor.progress}
        reply = await self._reply(self.redis.xread(positions, block=_BLOCK_MS))
        entries = {name.decode(): events.decode(found) for name, found in reply or []}
        return _merge(entries.get(states, []), entries.get(progress, []))

    async def _reply(self, pending: Any) -> Any:
        return await pending


def _merge(states: list[Stored], progress: list[Stored]) -> list[tuple[Stored, bool]]:
    """Both in the order of time, each in its own order; True marks states.

    Within one millisecond a state goes before the progress made in it, but a final state after what led to it.
    """
    merged: list[tuple[Stored, bool]] = []
    waiting = progress[::-1]
    for stored in states:
        final = isinstance(stored.event, StateEvent) and stored.event.state.final
        while waiting and (waiting[-1].at <= stored.at if final else waiting[-1].at < stored.at):
            merged.append((waiting.pop(), False))
        merged.append((stored, True))
    return merged + [(stored, False) for stored in reversed(waiting)]


async def event_stream(follower: Follower, heartbeat: float, open_streams: Gauge) -> AsyncIterator[bytes]:
    """The bytes of a `text/event-stream`, with a comment whenever `heartbeat` seconds pass in silence."""
    records = follower.run()
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
                return  # At a job's end; or Redis went away, and the client comes back with its last id.
            yield encode(record)
    finally:
        open_streams.dec()
        if pending is not None:
            pending.cancel()
            await asyncio.wait({pending})


def encode(record: EventRecord) -> bytes:
    """One message. `data` is a single line also for readers that take U+2028 and its like for ends of lines."""
    data = record.model_dump_json(exclude_none=True).translate(_LINE_ENDS)
    return f"id: {record.id}\nevent: {record.event.type}\ndata: {data}\n\n".encode()


async def stored_stream(job: Job) -> AsyncIterator[bytes]:
    """The one thing storage still knows of a job that Redis has lost: how it ended."""
    event = StateEvent(state=job.state, problem=job.problem)
    at = job.finished_at or job.created_at
    yield encode(EventRecord(id=f"{START}_{START}_0", attempt=job.attempt, at=at, event=event))
