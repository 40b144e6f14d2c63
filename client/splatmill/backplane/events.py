"""The event streams of a job. Only workers append.

`states` is never trimmed, and each other stream has a bound of its own: frequent progress does not push out log lines,
a talkative log does not push out warnings, and neither pushes out the curve.

Each entry carries its generation and attempt. Its time is taken from the entry's id, which Redis assigns, so all
machines share one clock.
"""

import heapq
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, cast

import redis

from splatmill.backplane import keys
from splatmill.backplane.records import FORMAT, check_format, reason, warn
from splatmill.schema import (
    EVENT,
    CamerasEvent,
    CurveRow,
    Event,
    EventRecord,
    LogEvent,
    MetricEvent,
    PlanEvent,
    PreviewEvent,
    ProgressEvent,
    SnapshotEvent,
    StateEvent,
)
from splatmill.schema.tolerant import keep_readable

BOUNDS: dict[Callable[[str], str], int | None] = {
    keys.states: None,
    keys.progress: 4000,
    keys.log: 5000,
    keys.warnings: 5000,
    keys.curve: 5000,
}
"""The streams of a job, as functions from its id to the key, each with the number of newest entries that are kept. In
order of the time that their entries are reported with, where that is the same millisecond."""

START = "0-0"
"""The position before the first entry of a stream."""

_PAGE = 100  # entries per read
_PAGES = 10


@dataclass(frozen=True)
class StoredEvent:
    """An event in a stream.

    id: id of the entry in its stream, `<milliseconds>-<number>`.
    generation: generation of the job; each restart begins a new one.
    attempt: number of the attempt that appended it.
    event: the event itself.
    """

    id: str
    generation: int
    attempt: int
    event: Event

    @property
    def at(self) -> datetime:
        return datetime.fromtimestamp(int(self.id.partition("-")[0]) / 1000, UTC)

    @property
    def order(self) -> tuple[int, int]:
        """A key that sorts the entries of a stream as Redis does; ids do not sort as text."""
        return stream_order(self.id)

    def record(self, cursor: str) -> EventRecord:
        """Return the event as it is sent to clients, with `cursor`, a position in all streams, as its id."""
        return EventRecord(id=cursor, attempt=self.attempt, at=self.at, event=self.event)


def stream_order(entry_id: str) -> tuple[int, int]:
    """Return the two numbers in the id of a stream entry."""
    milliseconds, _, number = entry_id.partition("-")
    return int(milliseconds), int(number or 0)


def stream_of(event: Event) -> Callable[[str], str]:
    """Return the stream for an event, one of BOUNDS."""
    match event:
        case StateEvent() | PlanEvent():
            return keys.states
        case LogEvent():
            return keys.warnings if event.level in ("warning", "error") else keys.log
        case MetricEvent():
            return keys.curve
        case ProgressEvent() | PreviewEvent() | CamerasEvent() | SnapshotEvent():
            return keys.progress


def begin_attempt(connection: redis.Redis, job_id: str) -> int:
    """Count a new attempt and return its number, which starts at 1 and continues over generations. For workers."""
    return connection.incr(keys.attempts(job_id))


def append(connection: redis.Redis, job_id: str, generation: int, attempt: int, event: Event) -> str:
    """Append an event to its stream and return the id of the entry. For workers."""
    stream = stream_of(event)
    fields = {"g": generation, "a": attempt, "e": event.model_dump_json(exclude_none=True), "format": FORMAT}
    return cast(bytes, connection.xadd(stream(job_id), cast(Any, fields), maxlen=BOUNDS[stream])).decode()


Entries = Iterable[tuple[bytes, Mapping[bytes, bytes]]]
"""The reply to XRANGE, XREVRANGE, or XREAD of one stream."""


def decode(entries: Entries, stream: str) -> list[StoredEvent]:
    """Return the events among the entries of `stream`, in the same order.

    An entry that this version cannot read, such as an event of an unknown type, is left out and logged.
    """
    found = []
    for entry_id, fields in entries:
        name = f"entry {entry_id.decode()} of {stream}"
        try:
            event, left_out = _event(fields)
            found.append(StoredEvent(entry_id.decode(), int(fields[b"g"]), int(fields[b"a"]), event))
        except (KeyError, ValueError, TypeError, AttributeError) as error:
            warn(name, f"skipped, because it cannot be read: {reason(error)}")
        else:
            if left_out:
                warn(name, f"left out what this version cannot read: {'; '.join(left_out)[:300]}")
    return found


def _event(fields: Mapping[bytes, bytes]) -> tuple[Event, list[str]]:
    check_format({"format": fields[b"format"]} if b"format" in fields else {})
    # Errors of the union name the type before the field.
    return keep_readable(EVENT.validate_python, json.loads(fields[b"e"]), depth=1)


def read_states(connection: redis.Redis, job_id: str) -> list[StoredEvent]:
    """Return all states and plans of a job, oldest first."""
    key = keys.states(job_id)
    return decode(cast(Any, connection.xrange(key)), key)


def read_progress(connection: redis.Redis, job_id: str) -> list[StoredEvent]:
    """Return the entries of a job's progress stream that were not trimmed, oldest first."""
    key = keys.progress(job_id)
    return decode(cast(Any, connection.xrange(key)), key)


def read_log(connection: redis.Redis, job_id: str) -> list[StoredEvent]:
    """Return the log lines of all attempts at a job that were not trimmed, oldest first."""
    found = _read(connection, job_id, keys.progress, keys.log, keys.warnings)
    return [stored for stored in found if isinstance(stored.event, LogEvent)]


def read_curve(connection: redis.Redis, job_id: str) -> list[CurveRow]:
    """Return the curve of a job, by step. An attempt that resumed replaces the rows that came after its checkpoint."""
    rows: list[CurveRow] = []
    for stored in _read(connection, job_id, keys.progress, keys.curve):
        if isinstance(stored.event, MetricEvent):
            row = CurveRow.model_validate(stored.event.model_dump(exclude={"type"}))
            while rows and rows[-1].step >= row.step:
                rows.pop()
            rows.append(row)
    return rows


def time_order(stored: StoredEvent) -> tuple[datetime, int]:
    """Return a key that sorts entries of different streams of a job by time.

    Within a millisecond, a state comes before other events, but a final state after them.
    """
    event = stored.event
    if isinstance(event, StateEvent) and event.state.final:
        return stored.at, 2
    return stored.at, 0 if isinstance(event, StateEvent | PlanEvent) else 1


def _read(connection: redis.Redis, job_id: str, *streams: Callable[[str], str]) -> list[StoredEvent]:
    with connection.pipeline(transaction=False) as pipe:
        for stream in streams:
            pipe.xrange(stream(job_id))
        replies = pipe.execute()
    found = [decode(reply, stream(job_id)) for stream, reply in zip(streams, replies, strict=True)]
    return list(heapq.merge(*found, key=time_order))  # keeps the order within each


def last_progress(connection: redis.Redis, job_id: str) -> StoredEvent | None:
    """Return the newest `ProgressEvent` among the last 1000 entries of the progress stream, or None."""
    key, end = keys.progress(job_id), "+"
    for _ in range(_PAGES):
        page = cast(Any, connection.xrevrange(key, max=end, count=_PAGE))
        for stored in decode(page, key):
            if isinstance(stored.event, ProgressEvent):
                return stored
        if len(page) < _PAGE:
            return None
        end = f"({page[-1][0].decode()}"
    return None
