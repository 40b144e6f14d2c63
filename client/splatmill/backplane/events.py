"""The two event streams of a job: `states` is never trimmed, `progress` is. Only the worker appends.

Each entry carries the generation and attempt that said it; its time is Redis's own, taken from the entry's id, so
that all machines share one clock.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, cast

import redis

from splatmill.backplane import keys
from splatmill.schema import EVENT, Event, EventRecord, PlanEvent, ProgressEvent, StateEvent

PROGRESS_LENGTH = 4000
"""Entries of the progress stream that are kept, about one megabyte per job."""

START = "0-0"
"""The position before the first entry of a stream."""

_PAGE = 100
_PAGES = 10


@dataclass(frozen=True)
class Stored:
    """An event as it lies in a stream. `id` is the entry's id in its own stream, `<milliseconds>-<number>`."""

    id: str
    generation: int
    attempt: int
    event: Event

    @property
    def at(self) -> datetime:
        return datetime.fromtimestamp(int(self.id.partition("-")[0]) / 1000, UTC)

    @property
    def order(self) -> tuple[int, int]:
        """Sorts entries of one stream as Redis does; ids do not sort as text."""
        return stream_order(self.id)

    def record(self, cursor: str) -> EventRecord:
        """The event on the wire, with `cursor` (a position in both streams) as its id."""
        return EventRecord(id=cursor, attempt=self.attempt, at=self.at, event=self.event)


def stream_order(entry_id: str) -> tuple[int, int]:
    """The two numbers of a stream entry's id."""
    milliseconds, _, number = entry_id.partition("-")
    return int(milliseconds), int(number or 0)


def stream_of(job_id: str, event: Event) -> str:
    """The key of the stream an event belongs to: what the fold cannot do without is never trimmed."""
    return keys.states(job_id) if isinstance(event, StateEvent | PlanEvent) else keys.progress(job_id)


def begin_attempt(connection: redis.Redis, job_id: str) -> int:
    """Count a new attempt and return its number, from 1 up over all generations. Called by the worker, once."""
    return connection.incr(keys.attempts(job_id))


def append(connection: redis.Redis, job_id: str, generation: int, attempt: int, event: Event) -> str:
    """Append an event and return its id in its stream. Called by the worker only."""
    key = stream_of(job_id, event)
    fields = {"g": generation, "a": attempt, "e": event.model_dump_json(exclude_none=True)}
    maxlen = PROGRESS_LENGTH if key == keys.progress(job_id) else None
    return cast(bytes, connection.xadd(key, cast(Any, fields), maxlen=maxlen)).decode()


def decode(entries: Iterable[tuple[bytes, Mapping[bytes, bytes]]]) -> list[Stored]:
    """The events in a reply of XRANGE, XREVRANGE or one stream of XREAD, in its order."""
    return [
        Stored(
            id=entry_id.decode(),
            generation=int(fields[b"g"]),
            attempt=int(fields[b"a"]),
            event=EVENT.validate_json(fields[b"e"]),
        )
        for entry_id, fields in entries
    ]


def read_states(connection: redis.Redis, job_id: str) -> list[Stored]:
    """Every state and plan of a job, oldest first."""
    return decode(cast(Any, connection.xrange(keys.states(job_id))))


def read_progress(connection: redis.Redis, job_id: str) -> list[Stored]:
    """What is left of a job's progress stream, oldest first."""
    return decode(cast(Any, connection.xrange(keys.progress(job_id))))


def last_progress(connection: redis.Redis, job_id: str) -> Stored | None:
    """The newest `ProgressEvent`. Log lines and metrics lie in between, so it looks back over at most 1000 entries."""
    end = "+"
    for _ in range(_PAGES):
        page = decode(cast(Any, connection.xrevrange(keys.progress(job_id), max=end, count=_PAGE)))
        for stored in page:
            if isinstance(stored.event, ProgressEvent):
                return stored
        if len(page) < _PAGE:
            return None
        end = f"({page[-1].id}"
    return None
