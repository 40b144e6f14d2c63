"""Makes the lists of jobs, and restores from storage the jobs that Redis has lost.

A job that has ended is in its log (`log`), an unfinished one in its request (`requests`). Both become rows again, with
the states and times that they had, so that a restored job is listed, restarted and deleted as any other.
"""

from collections.abc import Sequence
from typing import Any, cast

import redis
import structlog

from splatmill.backplane import keys, lists
from splatmill.backplane.jobs import events
from splatmill.backplane.jobs.row import JobRow, Verdict
from splatmill.backplane.queue import leases
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.records import FORMAT
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import Event, Job, JobState, PlanEvent, ProgressEvent, StateEvent, StoredKind
from splatmill_server.base.lists import Ended, Lists, each
from splatmill_server.jobs import labels as job_labels
from splatmill_server.jobs import log as job_log
from splatmill_server.jobs import requests, shrinking
from splatmill_server.jobs.reading import read_jobs

log = structlog.get_logger()

GRACE = leases.LEASE
"""Seconds for which a restored job is not put into the queue: a process that runs it takes its lease again by then."""

_BATCH = 500

_PUT_ROW = """
if redis.call('EXISTS', KEYS[1]) == 0 then redis.call('HSET', KEYS[1], unpack(ARGV)) end
"""
"""Inserts a row, unless there is one: the request that makes the job may just have inserted it."""


def make_lists(connection: redis.Redis, storage: Storage, listed: Lists, succeeded: dict[str, Ended]) -> int:
    """List all jobs that have rows, restore those that storage alone knows, and return the number of both.

    succeeded: gets the jobs that have.
    """
    lists.clear(connection, "jobs")
    count = _list_rows(connection, succeeded)
    unfinished = requests.list_ids(storage)
    for start in range(0, len(unfinished), _BATCH):
        count += restore_unfinished(connection, storage, unfinished[start : start + _BATCH])
    ended, labelled = storage.children(layout.jobs()), job_labels.labelled(storage)
    for start in range(0, len(ended), _BATCH):
        batch = ended[start : start + _BATCH]
        count += _restore_ended(connection, storage, listed, batch, succeeded, labelled)
    return count


def without_row(connection: redis.Redis, job_ids: Sequence[str]) -> list[str]:
    """Return those of the jobs that have no row."""
    with connection.pipeline(transaction=False) as pipe:
        for job_id in job_ids:
            pipe.exists(keys.job(job_id))
        known = pipe.execute()
    return [job_id for job_id, there in zip(job_ids, known, strict=True) if not there]


def restore_unfinished(connection: redis.Redis, storage: Storage, job_ids: Sequence[str]) -> int:
    """Restore those of the unfinished jobs that have no row, and return their number.

    They are not put into the queue at once, because a worker that still runs one takes its lease again (see GRACE).
    """
    missing = without_row(connection, job_ids)
    labelled = job_labels.labelled(storage) if missing else frozenset()
    rows = [
        job_row
        for job_row in each(lambda job_id: _unfinished(storage, job_id, labelled), missing)
        if job_row is not None
    ]
    if not rows:
        return 0
    with connection.pipeline() as pipe:
        for job_row in rows:
            _put_row(pipe, job_row)
            pipe.hset(keys.latest(job_row.id), keys.SHRUNK, 1)
            created = lists.milliseconds(job_row.created_at)
            lists.put_job(pipe, job_row.id, created, job_row.owner, job_row.capture, lists.UNFINISHED)
            pipe.sadd(keys.ACTIVE, job_row.id)
            pipe.sadd(keys.RESTORED, job_row.id)
        pipe.expire(keys.RESTORED, GRACE)
        pipe.execute()
    log.warning("jobs that Redis has lost were restored from storage", jobs=len(rows))
    return len(rows)


def _put_row(pipe: Any, job_row: JobRow) -> None:
    fields = [part for field in job_row.fields().items() for part in field]
    pipe.eval(_PUT_ROW, 1, keys.job(job_row.id), *fields)


def _unfinished(storage: Storage, job_id: str, labelled: frozenset[str]) -> JobRow | None:
    """Return the row of an unfinished job, or None if its generation has ended and only the request was left."""
    request = requests.get(storage, job_id, labelled)
    ended = job_log.get_stored_end(storage, job_id, labelled) if request is not None else None
    if request is not None and ended is not None and ended.generation >= request.generation:
        storage.delete(layout.unfinished_job(job_id))
        return None
    return request


def _list_rows(connection: redis.Redis, succeeded: dict[str, Ended]) -> int:
    """List the jobs that have rows, each in its group."""
    active = {entry.decode() for entry in cast(set[bytes], connection.smembers(keys.ACTIVE))}
    now, count = connection.time()[0], 0
    for batch in lists.members(connection, keys.JOBS, _BATCH):
        held = read_jobs(connection, batch)
        with connection.pipeline() as pipe:
            for job_id, held_job in held.items():
                unfinished = job_id in active or not held_job.state.final
                group = lists.UNFINISHED if unfinished else held_job.state.value
                created = lists.milliseconds(held_job.row.created_at)
                lists.put_job(pipe, job_id, created, held_job.row.owner, held_job.row.capture, group)
                if not unfinished:
                    shrinking.note(pipe, job_id, now)
                    _note(succeeded, held_job.job())
            pipe.execute()
        count += len(held)
    return count


def _restore_ended(
    connection: redis.Redis,
    storage: Storage,
    listed: Lists,
    job_ids: Sequence[str],
    succeeded: dict[str, Ended],
    labelled: frozenset[str],
) -> int:
    """Restore those of the jobs that have ended and have no row, and return their number."""
    missing = [job_id for job_id in without_row(connection, job_ids) if layout.is_id(job_id)]
    ends = [
        end
        for end in each(lambda job_id: job_log.get_stored_end(storage, job_id, labelled), missing)
        if end is not None
    ]
    with connection.pipeline() as pipe:
        added = lists.Additions()
        for end in ends:
            _restore(pipe, added, end.job, end.generation)
            _note(succeeded, end.job)
        added.send(pipe)
        pipe.execute()
    for job_id in listed.deleted(StoredKind.model, [end.job.id for end in ends]):
        if not storage.exists(layout.job_log(job_id)):
            (end,) = (end for end in ends if end.job.id == job_id)
            with connection.pipeline() as pipe:
                pipe.delete(*keys.of_job(job_id))
                lists.remove_job(pipe, job_id, end.job.owner, end.job.capture)
                pipe.execute()
    return len(ends)


def _note(succeeded: dict[str, Ended], job: Job) -> None:
    """Note a job if it has succeeded. It ended just after its model was stored."""
    if job.state is JobState.succeeded:
        moment = lists.milliseconds(job.finished_at or job.created_at)
        succeeded[job.id] = Ended(
            moment, job.owner or JobRow.model_fields["owner"].default, job.name, job.tags, job.favourite
        )


def _restore(pipe: Any, added: lists.Additions, job: Job, generation: int) -> None:
    """Write the row, the states and the newest progress from which `fold` makes this job, and add it to its lists."""
    ended = job.finished_at or job.created_at
    begun = min(job.started_at, ended) if job.started_at is not None else None
    said: list[tuple[Any, Event]] = []
    if begun is not None:
        said.append((begun, StateEvent(state=JobState.preparing)))
    if job.plan is not None:
        said.append((begun or ended, PlanEvent(plan=job.plan)))
    if job.state is not JobState.cancelled:
        said.append((ended, StateEvent(state=job.state, problem=job.problem)))
    last = events.START
    for number, (moment, event) in enumerate(said):
        last = f"{lists.milliseconds(moment)}-{number}"
        fields = {
            "g": generation,
            "a": job.attempt,
            "e": event.model_dump_json(exclude_none=True),
            "format": FORMAT,
        }
        pipe.xadd(keys.states(job.id), fields, id=last)
    verdict = (
        Verdict(state="cancelled", at=ended, after=last, problem=job.problem)
        if job.state is JobState.cancelled
        else None
    )
    row = JobRow(
        id=job.id,
        capture=job.capture,
        name=job.name,
        tags=job.tags,
        favourite=job.favourite,
        owner=job.owner or JobRow.model_fields["owner"].default,
        options=job.options,
        priority=job.priority,
        created_at=job.created_at,
        queued_at=job.created_at,
        generation=generation,
        cancel_requested_at=ended if job.cancel_requested else None,
        verdict=verdict,
    )
    _put_row(pipe, row)
    pipe.hset(keys.latest(job.id), keys.SHRUNK, 1)
    if job.progress is not None:
        newest = ProgressEvent.model_validate(job.progress.model_dump())
        pipe.hset(keys.latest(job.id), *events.newest_entry(last, generation, job.attempt, newest))
    pipe.set(keys.attempts(job.id), job.attempt)
    lists.put_job(added, job.id, lists.milliseconds(job.created_at), row.owner, job.capture, job.state.value)
