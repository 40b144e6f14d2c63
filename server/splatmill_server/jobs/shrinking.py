"""What Redis lets go of a job that has ended: its log, its curve and its progress, which are in storage by then.

An ended job keeps its row, its states and its newest progress, a few kilobytes. Its streams stay whole for
WHOLE_SECONDS after the end was stored, so that those who follow its events, and were behind, receive all of them.
"""

from collections.abc import Sequence
from typing import Any, cast

import redis

from splatmill.backplane import keys
from splatmill.backplane.jobs import events, row
from splatmill.backplane.jobs.events import StoredEvent
from splatmill.backplane.jobs.fold import fold
from splatmill.backplane.jobs.row import JobRow
from splatmill.backplane.storage.records import UnreadableRecord
from splatmill.schema import PlanEvent, StateEvent

WHOLE_SECONDS = 60.0
"""Seconds for which the streams of an ended job stay whole."""

_MOST = 500
"""Number of jobs whose streams are shrunk at once; the next call continues."""

_SHRUNK = (keys.progress, keys.log, keys.warnings, keys.curve)


def note(pipe: Any, job_id: str, moment: float) -> None:
    """Note, in a transaction, that the streams of an ended job may be shrunk from a time in seconds on."""
    pipe.zadd(keys.UNSHRUNK, {job_id: int((moment + WHOLE_SECONDS) * 1000)})


def shrink_due(connection: redis.Redis) -> int:
    """Shrink the streams of the jobs whose time has come by the clock of Redis, and return the number of jobs."""
    now = connection.time()[0] * 1000
    due = cast(list[bytes], connection.zrangebyscore(keys.UNSHRUNK, "-inf", now, start=0, num=_MOST))
    for member in due:
        shrink(connection, member.decode())
    return len(due)


def shrink(connection: redis.Redis, job_id: str) -> None:
    """Delete the streams of a job but its states, unless it was restarted meanwhile."""

    def apply(pipe: Any) -> None:
        job_row: JobRow | None = None
        try:
            job_row = row.read(connection, job_id)
            stored = cast(Any, connection.xrange(keys.states(job_id)))
            states = events.decode(stored, keys.states(job_id))
            ended = job_row is not None and fold(job_row, states).state.final
        except UnreadableRecord:
            ended = False  # its streams stay until it is deleted
        pipe.multi()
        pipe.zrem(keys.UNSHRUNK, job_id)
        if job_row is not None and ended:
            pipe.delete(*(stream(job_id) for stream in _SHRUNK))
            pipe.hset(keys.latest(job_id), keys.SHRUNK, 1)
            kept = _needed(job_row, states)
            if len(kept) < len(states):
                # Written anew under the same ids: Redis keeps the memory of single entries that are deleted.
                pipe.delete(keys.states(job_id))
                for entry_id, fields in stored:
                    if entry_id.decode() in kept:
                        pipe.xadd(keys.states(job_id), fields, id=entry_id)

    connection.transaction(apply, keys.job(job_id), keys.states(job_id))


def _needed(job_row: JobRow, states: Sequence[StoredEvent]) -> set[str]:
    """Return the ids of the states and plans that tell the job.

    A job that was interrupted a hundred times has those of a hundred attempts.
    """
    last = max((stored.attempt for stored in states if stored.generation == job_row.generation), default=0)
    kept, begun, planned = [], False, None
    for stored in states:
        if stored.generation != job_row.generation:
            continue
        first = not begun and isinstance(stored.event, StateEvent)
        begun = begun or first
        if isinstance(stored.event, PlanEvent):
            planned = stored
        elif stored.attempt == last or first:
            kept.append(stored)
    if planned is not None:
        kept.append(planned)
    kept.sort(key=lambda stored: stored.order)
    same = fold(job_row, kept) == fold(job_row, states)
    return {stored.id for stored in (kept if same else states)}
