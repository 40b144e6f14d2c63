"""Jobs in Redis as the server writes and reads them, for tests of a worker without a server."""

from typing import Any, cast

import redis

from splatmill.backplane import keys
from splatmill.backplane.jobs import events
from splatmill.backplane.jobs.fold import fold
from splatmill.backplane.jobs.row import JobRow, now, read
from splatmill.schema import Job, TrainOptions

CAPTURE = "capture1"


def write_row(connection: redis.Redis, job_id: str, **changes: Any) -> JobRow:
    """Write the row of a new job on CAPTURE."""
    fields = {
        "id": job_id,
        "capture": CAPTURE,
        "options": TrainOptions(),
        "created_at": now(),
        "queued_at": now(),
    }
    row = JobRow(**cast(Any, fields | changes))
    connection.hset(keys.job(job_id), mapping=cast(dict[Any, Any], row.fields()))
    return row


def read_job(connection: redis.Redis, job_id: str) -> Job:
    """Return the job as a client sees it."""
    row = read(connection, job_id)
    assert row is not None
    states = events.read_states(connection, job_id)
    return fold(row, states, events.last_progress(connection, job_id))


def read_progress(connection: redis.Redis, job_id: str) -> list[events.StoredEvent]:
    """Return the entries of a job's progress stream that were not trimmed, oldest first."""
    key = keys.progress(job_id)
    return events.decode(cast(Any, connection.xrange(key)), key)


def messages(connection: redis.Redis, job_id: str) -> list[str]:
    """Return the job's log lines."""
    logged = [stored.event for stored in events.read_log(connection, job_id)]
    return [event.message for event in logged if event.type == "log"]
