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
from splatmill.backplane.storage.records import FORMAT, check_format, reason, warn
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
    UnitEvent,
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

LATEST: dict[type, str] = {ProgressEvent: "progress", PreviewEvent: "preview"}
"""The types of events whose newest entry is in the hash `keys.latest` too, each with its field. So no reader looks for
them in a stream of thousands of entries."""

ENDS_KEPT = 1000
"""Ends of jobs that wait in `keys.ENDS` for a server at most. The reaper finds the others."""

# KEYS: stream, hash of the newest entries, states, ends. ARGV: generation, attempt, event, format, bound or "",
# field or "", "1" if nothing is to be appended where there are no states, the job if the event is its end or "",
# ENDS_KEPT.
_APPEND = """
if ARGV[7] == '1' and redis.call('EXISTS', KEYS[3]) == 0 then return false end
local bound = ARGV[5] == '' and {} or {'MAXLEN', '~', ARGV[5]}
local entry = {'*', 'g', ARGV[1], 'a', ARGV[2], 'e', ARGV[3], 'format', ARGV[4]}
for _, part in ipairs(entry) do bound[#bound + 1] = part end
local id = redis.call('XADD', KEYS[1], unpack(bound))
if ARGV[6] ~= '' then
  redis.call('HSET', KEYS[2], ARGV[6], table.concat({id, ARGV[1], ARGV[2], ARGV[4], ARGV[3]}, ' '))
end
if ARGV[8] ~= '' then
  redis.call('LPUSH', KEYS[4], ARGV[8])
  redis.call('LTRIM', KEYS[4], 0, ARGV[9] - 1)
end
return id
"""


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
        case UnitEvent():
            return keys.log
        case MetricEvent():
            return keys.curve
        case ProgressEvent() | PreviewEvent() | CamerasEvent() | SnapshotEvent():
            return keys.progress


def begin_attempt(connection: redis.Redis, job_id: str) -> int:
    """Count a new attempt and return its number, which starts at 1 and continues over generations. For workers."""
    return connection.incr(keys.attempts(job_id))


def append(connection: redis.Redis, job_id: str, generation: int, attempt: int, event: Event) -> str:
    """Append an event to its stream and return the id of the entry. For workers."""
    return cast(bytes, _append(connection, job_id, generation, attempt, event, known=False)).decode()


def append_if_known(
    connection: redis.Redis, job_id: str, generation: int, attempt: int, event: Event
) -> bool:
    """Append an event unless Redis has no states of the job, as one that has lost its data. Return whether it has."""
    return _append(connection, job_id, generation, attempt, event, known=True) is not None


def _append(
    connection: redis.Redis, job_id: str, generation: int, attempt: int, event: Event, *, known: bool
) -> bytes | None:
    stream = stream_of(event)
    bound, field = BOUNDS[stream], LATEST.get(type(event), "")
    entry = generation, attempt, event.model_dump_json(exclude_none=True), FORMAT
    script = connection.register_script(_APPEND)
    names = [stream(job_id), keys.latest(job_id), keys.states(job_id), keys.ENDS]
    ended = job_id if isinstance(event, StateEvent) and event.state.final else ""
    arguments = [*entry, bound or "", field, int(known), ended, ENDS_KEPT]
    return cast("bytes | None", script(keys=names, args=arguments))


Entries = Iterable[tuple[bytes, Mapping[bytes, bytes]]]
"""The reply to XRANGE, XREVRANGE, or XREAD of one stream."""


def decode(entries: Entries, stream: str) -> list[StoredEvent]:
    """Return the events among the entries of `stream`, in the same order.

    An entry that this version cannot read, such as an event of an unknown type, is left out and logged.
    """
    decoded = []
    for entry_id, fields in entries:
        name = f"entry {entry_id.decode()} of {stream}"
        try:
            event, left_out = _event(fields)
            decoded.append(StoredEvent(entry_id.decode(), int(fields[b"g"]), int(fields[b"a"]), event))
        except (KeyError, ValueError, TypeError, AttributeError) as error:
            warn(name, f"skipped, because it cannot be read: {reason(error)}")
        else:
            if left_out:
                warn(name, f"left out what this version cannot read: {'; '.join(left_out)[:300]}")
    return decoded


def _event(fields: Mapping[bytes, bytes]) -> tuple[Event, list[str]]:
    check_format({"format": fields[b"format"]} if b"format" in fields else {})
    # Errors of the union name the type before the field.
    return keep_readable(EVENT.validate_python, json.loads(fields[b"e"]), depth=1)


def read_states(connection: redis.Redis, job_id: str) -> list[StoredEvent]:
    """Return all states and plans of a job, oldest first."""
    key = keys.states(job_id)
    return decode(cast(Any, connection.xrange(key)), key)


def read_log(connection: redis.Redis, job_id: str) -> list[StoredEvent]:
    """Return the log lines of all attempts at a job that were not trimmed, oldest first."""
    stored_events = _read(connection, job_id, keys.log, keys.warnings)
    return [stored for stored in stored_events if isinstance(stored.event, LogEvent)]


def read_curve(connection: redis.Redis, job_id: str) -> list[CurveRow]:
    """Return the curve of a job as far as Redis has it, by step (see `joined`)."""
    metrics = (
        stored.event
        for stored in _read(connection, job_id, keys.curve)
        if isinstance(stored.event, MetricEvent)
    )
    return joined(CurveRow.model_validate(event.model_dump(exclude={"type"})) for event in metrics)


def joined(measured: Iterable[CurveRow]) -> list[CurveRow]:
    """Return rows of a curve by step. An attempt that resumed replaces the rows that came after its checkpoint.

    measured: rows in the order in which they were measured.
    """
    rows: list[CurveRow] = []
    for row in measured:
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
    decoded = [decode(reply, stream(job_id)) for stream, reply in zip(streams, replies, strict=True)]
    return list(heapq.merge(*decoded, key=time_order))  # keeps the order within each


def last_progress(connection: redis.Redis, job_id: str) -> StoredEvent | None:
    """Return the newest `ProgressEvent` of a job, or None."""
    return answered_progress(ask_progress(connection, job_id), job_id)


def ask_progress(pipe: Any, job_id: str) -> Any:
    """Ask for what `answered_progress` reads, by a connection or a pipeline."""
    return pipe.hget(keys.latest(job_id), LATEST[ProgressEvent])


def answered_progress(stored: bytes | None, job_id: str) -> StoredEvent | None:
    """Return the newest `ProgressEvent` of a job that the reply to `ask_progress` holds, or None."""
    return _latest(stored, job_id) if stored is not None else None


def newest_entry(entry_id: str, generation: int, attempt: int, event: Event) -> tuple[str, str]:
    """Return the field of `keys.latest` for an event of one of the types in LATEST, and its value."""
    stored = f"{entry_id} {generation} {attempt} {FORMAT} {event.model_dump_json(exclude_none=True)}"
    return LATEST[type(event)], stored


def last_preview(connection: redis.Redis, job_id: str) -> PreviewEvent | None:
    """Return the newest `PreviewEvent` of a job, or None if its worker noted none."""
    stored = cast(bytes | None, connection.hget(keys.latest(job_id), LATEST[PreviewEvent]))
    newest = _latest(stored, job_id) if stored is not None else None
    return newest.event if newest is not None and isinstance(newest.event, PreviewEvent) else None


def _latest(stored: bytes, job_id: str) -> StoredEvent | None:
    """Return the event in a field of `keys.latest`, or None if it cannot be read."""
    entry_id, generation, attempt, version, event = (*stored.split(b" ", 4), *[b""] * 4)[:5]
    fields = {b"g": generation, b"a": attempt, b"format": version, b"e": event}
    return next(iter(decode([(entry_id, fields)], keys.latest(job_id))), None)
