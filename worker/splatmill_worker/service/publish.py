"""A finished model goes to storage: its files first, `job.json` last, so that a model exists whole or not at all."""

import json
from pathlib import Path

from splatmill.backplane import events, layout
from splatmill.backplane.fold import fold
from splatmill.backplane.row import JobRow, now
from splatmill.backplane.storage import Storage
from splatmill.schema import JobState
from splatmill_worker.service.attempt import Attempt

_RECORD = "job.json"


def published(storage: Storage, this: Attempt) -> bool:
    """Whether an earlier attempt at this generation stored the whole model and died before it could say so."""
    try:
        record = json.loads(storage.get(layout.job_record(this.job_id)))
    except (FileNotFoundError, ValueError):
        return False
    return isinstance(record, dict) and record.get("generation") == this.generation


def publish(storage: Storage, this: Attempt, request: JobRow, out: Path) -> None:
    """Store the files of the pipeline's `out` folder as the job's model.

    The model of an earlier generation vanishes first: nobody may see one run's splats beside another's report.
    Raises StorageError, and FileNotFoundError when the pipeline left no model.ply.
    """
    if not (out / "model.ply").is_file():
        raise FileNotFoundError(f"The pipeline ended without writing {out / 'model.ply'}.")
    storage.delete(layout.job_record(this.job_id))
    for name in layout.MODEL_FILES:
        path = out / name
        if name != _RECORD and path.is_file():
            storage.put(layout.model_file(this.job_id, name), path)
    seen = fold(
        request,
        events.read_states(this.connection, this.job_id),
        events.last_progress(this.connection, this.job_id),
    )
    ended = seen.model_copy(
        update={
            "state": JobState.succeeded,
            "finished_at": now(),
            "model": this.job_id,
            "attempt": this.number,
        }
    )
    record = ended.model_dump(mode="json", exclude_none=True) | {"generation": this.generation}
    storage.put(layout.job_record(this.job_id), json.dumps(record, indent=1).encode())
