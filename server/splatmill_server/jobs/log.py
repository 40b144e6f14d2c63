"""The log of a job: read from Redis, and kept in storage once the job has ended.

    jobs/{id}/log.jsonl: {"format": 1, "generation": 1, "job": the job as it ended}, then a `LogLine` per line

The first line makes the log of a failed or cancelled job readable, for its owner, after Redis was lost.
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass

import redis

from splatmill.backplane import keys
from splatmill.backplane.jobs import events
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.records import FORMAT, check_format, reason, warn
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import Job, LogEvent, LogLine
from splatmill.schema.tolerant import keep_readable
from splatmill_server.jobs import labels
from splatmill_server.jobs.reading import is_deleted


def get(connection: redis.Redis, storage: Storage, job_id: str) -> list[LogLine]:
    """Return the log lines of all attempts at a job, oldest first.

    They are read from Redis, and from storage where Redis has shrunk or lost the job.
    """
    with connection.pipeline(transaction=False) as pipe:
        pipe.exists(keys.job(job_id))
        pipe.hexists(keys.latest(job_id), keys.SHRUNK)
        known, shrunk = pipe.execute()
    if not known:
        return _stored_lines(storage, job_id)
    fresh = [
        LogLine(attempt=stored.attempt, at=stored.at, **stored.event.model_dump())
        for stored in events.read_log(connection, job_id)
        if isinstance(stored.event, LogEvent)
    ]
    if not shrunk:
        return fresh
    # A job that ended, was restarted and ended again has its newest lines in both.
    earlier = _stored_lines(storage, job_id)
    return [line for line in earlier if not fresh or line.at < fresh[0].at] + fresh


def save(connection: redis.Redis, storage: Storage, job: Job, generation: int) -> None:
    """Store the log of a job that has ended. Raises StorageError, and redis.RedisError."""
    path = layout.job_log(job.id)
    ended = job.model_dump(mode="json", exclude_none=True)
    head = json.dumps({"format": FORMAT, "generation": generation, "job": ended})
    lines = [line.model_dump_json() for line in get(connection, storage, job.id)]
    storage.put(path, "\n".join([head, *lines, ""]).encode())
    if is_deleted(connection, job.id):
        storage.delete(path)


@dataclass(frozen=True)
class StoredEnd:
    """A job as it ended, and the generation that ended."""

    job: Job
    generation: int


def get_stored_end(storage: Storage, job_id: str, labelled: frozenset[str] | None = None) -> StoredEnd | None:
    """Return a job as it ended, from the file of its log, under its present labels, or None.

    labelled: the jobs that were given labels, where they are known.
    """
    end = _stored(storage, job_id)[0]
    if end is None or not end.job.state.final:
        return None
    return StoredEnd(labels.under(storage, job_id, end.job, labelled), end.generation)


def text(lines: Iterable[LogLine]) -> str:
    """Return log lines as plain text: time, attempt, level, message."""
    return "".join(
        f"{line.at:%Y-%m-%dT%H:%M:%S.%f}"[:-3]
        + f"Z  attempt {line.attempt}  {line.level:<7}  {line.message}\n"
        for line in lines
    )


def _stored(storage: Storage, job_id: str) -> tuple[StoredEnd | None, list[str]]:
    """Return the end of the job and the lines, as JSON, in the file of a log."""
    path = layout.job_log(job_id)
    try:
        head, *lines = storage.get(path).decode("utf-8", "replace").splitlines()
        record = json.loads(head)
        check_format(record)
        job, left_out = keep_readable(Job.model_validate, record["job"])
        end = StoredEnd(job, int(record.get("generation", 1)))
    except FileNotFoundError:
        return None, []
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        warn(path, f"cannot be read: {reason(error)}")
        return None, []
    if left_out:
        warn(path, f"left out what cannot be read: {'; '.join(left_out)[:300]}")
    return end, lines


def _stored_lines(storage: Storage, job_id: str) -> list[LogLine]:
    """Return the lines in the file of a log, without those that are not readable."""
    lines, left_out = [], []
    for line in _stored(storage, job_id)[1]:
        try:
            lines.append(LogLine.model_validate_json(line))
        except ValueError as error:
            left_out.append(reason(error))
    if left_out:
        warn(layout.job_log(job_id), f"left out what cannot be read: {'; '.join(left_out)[:300]}")
    return lines
