"""Names, tags and stars that jobs are given after they were made.

    names/{job}.json: {"format": 1, "name": the name or null, "tags": [...], "favourite": whether it has a star}

A model has the labels of its job. This record counts more than the records that workers write, which know the name that
the job had when their attempt began.
"""

import json
from typing import Any, TypeVar

import redis
from pydantic import Field

from splatmill.backplane import keys
from splatmill.backplane.jobs.row import JobRow
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.records import FORMAT, read_record
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import Job, Response
from splatmill.schema.base import Label
from splatmill.schema.resources.jobs.labels import Tags

Labelled = TypeVar("Labelled", Job, JobRow)


class Labels(Response):
    """The labels of a job, each in place of the one with which the job was made."""

    name: Label | None
    tags: Tags = Field(default_factory=list)
    favourite: bool = False


def save(storage: Storage, job_id: str, labels: Labels) -> None:
    """Store the labels of a job. Raises StorageError."""
    storage.put(layout.job_labels(job_id), json.dumps({"format": FORMAT} | labels.model_dump()).encode())


def delete(storage: Storage, job_id: str) -> None:
    """Delete the labels of a job that is deleted."""
    storage.delete(layout.job_labels(job_id))


def labelled(storage: Storage) -> frozenset[str]:
    """Return the ids of the jobs that were given labels."""
    entries = storage.entries(layout.labels())
    return frozenset(entry.path.rpartition("/")[2].removesuffix(".json") for entry in entries)


def get(storage: Storage, job_id: str) -> Labels | None:
    """Return the labels of a job, or None if it was given none that can be read."""
    return read_record(storage, layout.job_labels(job_id), Labels)


def write(connection: redis.Redis, job_id: str, labels: Labels) -> None:
    """Write labels into the row of a job, if it has one."""

    def change(pipe: Any) -> None:
        known = pipe.exists(keys.job(job_id))
        pipe.multi()
        if known:
            fields = {"tags": json.dumps(labels.tags), "favourite": str(labels.favourite)}
            pipe.hset(keys.job(job_id), mapping=fields)
        if known and labels.name is not None:
            pipe.hset(keys.job(job_id), "name", labels.name)
        elif known:
            pipe.hdel(keys.job(job_id), "name")
        pipe.hdel(keys.records("models"), job_id)

    connection.transaction(change, keys.job(job_id))


def under(storage: Storage, job_id: str, record: Labelled, among: frozenset[str] | None = None) -> Labelled:
    """Return the record of a job under its present labels.

    among: the jobs that were given labels, where they are known: nothing is read of others.
    """
    if among is not None and job_id not in among:
        return record
    labels = get(storage, job_id)
    return record if labels is None else record.model_copy(update=labels.model_dump())
