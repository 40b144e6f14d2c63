"""The curve of a job: read from Redis, and kept in storage once the job has ended.

    jobs/{id}/curve.jsonl: a `CurveRow` per line, in the order in which they were measured

A job that ended before it measured anything has no such file.
"""

import redis

from splatmill.backplane import keys
from splatmill.backplane.jobs import events
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.records import reason, warn
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import CurveRow
from splatmill_server.jobs.reading import is_deleted


def get(connection: redis.Redis, storage: Storage, job_id: str) -> list[CurveRow]:
    """Return the curve of a job by step: that of storage where Redis has shrunk or lost the job, then that of Redis."""
    fresh = events.read_curve(connection, job_id)
    with connection.pipeline(transaction=False) as pipe:
        pipe.hexists(keys.latest(job_id), keys.SHRUNK)
        pipe.exists(keys.job(job_id))
        shrunk, known = pipe.execute()
    return fresh if known and not shrunk else events.joined([*_stored(storage, job_id), *fresh])


def save(connection: redis.Redis, storage: Storage, job_id: str) -> None:
    """Store the curve of a job that has ended. Raises StorageError, and redis.RedisError."""
    path = layout.job_curve(job_id)
    if not (rows := get(connection, storage, job_id)):
        return
    storage.put(path, "".join(f"{row.model_dump_json(exclude_none=True)}\n" for row in rows).encode())
    if is_deleted(connection, job_id):
        storage.delete(path)


def _stored(storage: Storage, job_id: str) -> list[CurveRow]:
    path, rows = layout.job_curve(job_id), []
    try:
        lines = storage.get(path).decode("utf-8", "replace").splitlines()
    except FileNotFoundError:
        return []
    for line in lines:
        try:
            rows.append(CurveRow.model_validate_json(line))
        except ValueError as error:
            warn(path, f"left out what cannot be read: {reason(error)}")
    return rows
