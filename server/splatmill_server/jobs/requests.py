"""The rows of unfinished jobs in storage, from which they are restored where Redis has come back empty.

    watched/{job}.json: the row of the job as it began its generation

A row is stored before the job is inserted into Redis, and deleted when its end is stored.
"""

from datetime import datetime

import redis

from splatmill.backplane.jobs import row
from splatmill.backplane.jobs.row import JobRow
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.records import UnreadableRecord, read_record
from splatmill.backplane.storage.storage import Storage
from splatmill_server.jobs import labels


def save(storage: Storage, begun: JobRow) -> None:
    """Store the row of a job that begins. Raises StorageError."""
    storage.put(layout.unfinished_job(begun.id), begun.model_dump_json(exclude_none=True).encode())


def next_generation(job_row: JobRow, moment: datetime, request: str | None) -> JobRow:
    """Return the row of a job as its restart at this time, by this request, makes it."""
    changes = {"generation": job_row.generation + 1, "queued_at": moment, "request": request}
    return job_row.model_copy(update=changes | {"cancel_requested_at": None, "verdict": None})


def get(storage: Storage, job_id: str, labelled: frozenset[str] | None = None) -> JobRow | None:
    """Return the row of an unfinished job, under its present labels, or None if there is none to read."""
    begun = read_record(storage, layout.unfinished_job(job_id), JobRow)
    return None if begun is None else labels.under(storage, job_id, begun, labelled)


def list_ids(storage: Storage) -> list[str]:
    """Return the ids of all jobs whose rows are stored."""
    paths = (entry.path.rpartition("/")[2] for entry in storage.walk(layout.unfinished_jobs()))
    ids = (path.removesuffix(".json") for path in paths if path.endswith(".json"))
    return sorted(job_id for job_id in ids if layout.is_id(job_id))


def delete(connection: redis.Redis, storage: Storage, ended: JobRow) -> None:
    """Delete the row of a job whose end is stored, unless it was restarted meanwhile."""
    storage.delete(layout.unfinished_job(ended.id))
    try:
        job_row = row.read(connection, ended.id)
    except UnreadableRecord:
        return
    if job_row is not None and job_row.generation != ended.generation:
        save(storage, job_row)
