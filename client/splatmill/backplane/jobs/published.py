"""Whether a job has stored its model."""

import json

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage


def is_published(storage: Storage, job_id: str, generation: int) -> bool:
    """Return whether the whole model of a generation is stored; its `job.json` comes last. Raises StorageError."""
    try:
        record = json.loads(storage.get(layout.job_record(job_id)))
    except (FileNotFoundError, ValueError):
        return False
    return isinstance(record, dict) and record.get("generation") == generation
