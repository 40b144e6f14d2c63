"""The log of a job: read from Redis, and kept in storage once the job has ended.

    jobs/{id}/log.jsonl: {"format": 1, "job": the job as it ended}, then a `LogLine` per line

The first line makes the log of a failed or cancelled job readable, for its owner, after Redis was lost.
"""

import json
from collections.abc import Iterable

import redis

from splatmill.backplane import events, keys, layout
from splatmill.backplane.records import FORMAT, check_format, reason, warn
from splatmill.backplane.storage import Storage
from splatmill.schema import Job, LogEvent, LogLine
from splatmill.schema.tolerant import keep_readable


def read(connection: redis.Redis, storage: Storage, job_id: str) -> list[LogLine]:
    """Return the log lines of all attempts at a job, oldest first, from storage if Redis has lost the job."""
    if connection.exists(keys.job(job_id)):
        return [
            LogLine(
                attempt=stored.attempt, at=stored.at, level=stored.event.level, message=stored.event.message
            )
            for stored in events.read_log(connection, job_id)
            if isinstance(stored.event, LogEvent)
        ]
    return _stored(storage, job_id)[1]


def store(connection: redis.Redis, storage: Storage, job: Job) -> None:
    """Store the log of a job that has ended. Raises StorageError, and redis.RedisError."""
    path = layout.job_log(job.id)
    head = json.dumps({"format": FORMAT, "job": job.model_dump(mode="json", exclude_none=True)})
    lines = [line.model_dump_json() for line in read(connection, storage, job.id)]
    storage.put(path, "\n".join([head, *lines, ""]).encode())
    if not connection.exists(keys.job(job.id)):
        storage.delete(path)  # the job was deleted meanwhile


def stored_job(storage: Storage, job_id: str) -> Job | None:
    """Return the job as it ended, from the file of its log, or None."""
    return _stored(storage, job_id)[0]


def text(lines: Iterable[LogLine]) -> str:
    """Return log lines as plain text: time, attempt, level, message."""
    return "".join(
        f"{line.at:%Y-%m-%dT%H:%M:%S.%f}"[:-3]
        + f"Z  attempt {line.attempt}  {line.level:<7}  {line.message}\n"
        for line in lines
    )


def _stored(storage: Storage, job_id: str) -> tuple[Job | None, list[LogLine]]:
    """Return the job and the lines in the file of a log, without what is not readable in it."""
    path = layout.job_log(job_id)
    try:
        head, *lines = storage.get(path).decode("utf-8", "replace").splitlines()
        record = json.loads(head)
        check_format(record)
        job, left_out = keep_readable(Job.model_validate, record["job"])
    except FileNotFoundError:
        return None, []
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        warn(path, f"cannot be read: {reason(error)}")
        return None, []
    found = []
    for line in lines:
        try:
            found.append(LogLine.model_validate_json(line))
        except ValueError as error:
            left_out.append(reason(error))
    if left_out:
        warn(path, f"left out what cannot be read: {'; '.join(left_out)[:300]}")
    return job, found
