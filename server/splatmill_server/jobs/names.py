"""Names that jobs are given after they were made.

    names/{job}.json: {"format": 1, "name": the name, or null for none}

A model has the name of its job. This record counts more than the names in the records that workers write, which know
the name that the job had when their attempt began.
"""

import json

from pydantic import TypeAdapter, ValidationError

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.records import FORMAT, UnreadableRecord, check_format, reason, warn
from splatmill.backplane.storage.storage import Storage
from splatmill.schema.base import Label

_NAME: TypeAdapter[str | None] = TypeAdapter(Label | None)


def save(storage: Storage, job_id: str, name: str | None) -> None:
    """Store the name of a job. Raises StorageError."""
    storage.put(layout.job_name(job_id), json.dumps({"format": FORMAT, "name": name}).encode())


def delete(storage: Storage, job_id: str) -> None:
    """Delete the name of a job that is deleted."""
    storage.delete(layout.job_name(job_id))


def renamed(storage: Storage) -> frozenset[str]:
    """Return the ids of the jobs that were given another name."""
    entries = storage.entries(layout.names())
    return frozenset(entry.path.rpartition("/")[2].removesuffix(".json") for entry in entries)


def get(storage: Storage, job_id: str, first: str | None, among: frozenset[str] | None = None) -> str | None:
    """Return the name of a job; `first`, with which it was made, if it was given no other that can be read.

    among: the jobs that were renamed, where they are known: nothing is read of others.
    """
    if among is not None and job_id not in among:
        return first
    path = layout.job_name(job_id)
    try:
        record = json.loads(storage.get(path))
        check_format(record)
        return _NAME.validate_python(record["name"])
    except FileNotFoundError:
        return first
    except (UnreadableRecord, ValidationError, KeyError, ValueError, TypeError, AttributeError) as error:
        warn(path, f"cannot be read: {reason(error)}")
        return first
