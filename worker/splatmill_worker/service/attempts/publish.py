"""Stores a finished model: its files first and `job.json` last, so that a model with that record is complete."""

import hashlib
import json
from pathlib import Path

from splatmill.backplane import lists
from splatmill.backplane.jobs import events
from splatmill.backplane.jobs.fold import fold
from splatmill.backplane.jobs.row import JobRow, now
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.records import FORMAT
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import POSTER, JobState
from splatmill_worker.service.attempts.attempt import Attempt
from splatmill_worker.service.redis_patience import patiently
from splatmill_worker.service.room import Room

_RECORD, _PREVIEW = "job.json", "preview.jpg"


def _in_folders(out: Path) -> list[str]:
    """Return the names of the files in the folders of a model."""
    names = (path.relative_to(out).as_posix() for path in sorted(out.glob("*/*")))
    return [name for name in names if layout.model_media_type(name) is not None]


RECORD_BYTES = 64 << 10
"""Bytes reserved for `job.json`: the options of the job, and a digest of each file."""


def publish(storage: Storage, attempt: Attempt, row: JobRow, out: Path, room: Room) -> None:
    """Store the files of the pipeline's `out` folder as the job's model, once there is room for all of them.

    The record of an earlier generation is deleted first, so that no client sees a model and a report of two runs.
    Raises QuotaReached, StorageError, redis.RedisError when Redis fails for longer than PATIENCE, and FileNotFoundError
    when there is no model.ply.
    """
    if not (out / "model.ply").is_file():
        raise FileNotFoundError(f"The pipeline ended without writing {out / 'model.ply'}.")
    names = [*layout.MODEL_FILES, *_in_folders(out)]
    sizes = {name: path.stat().st_size for name in names if (path := out / name).is_file()}
    room.store_all(sizes | {_RECORD: RECORD_BYTES + 100 * len(sizes)})
    storage.delete(layout.job_record(attempt.job_id))
    patiently(lambda: lists.remove_model(attempt.connection, attempt.job_id, row.owner))
    digests: dict[str, str] = {}
    for entry in storage.entries(layout.model(attempt.job_id)):
        name = entry.path.removeprefix(layout.model(attempt.job_id) + "/")
        if name == POSTER or ("/" in name and name not in names):
            storage.delete(entry.path)  # of an earlier generation, which looked otherwise or had more of them
    for name in names:
        path = out / name
        if name != _RECORD and path.is_file():
            storage.put(layout.model_file(attempt.job_id, name), path)
            if name == _PREVIEW:
                continue  # a restarted job replaces it before the other files
            with path.open("rb") as file:
                digests[name] = hashlib.file_digest(file, "sha256").hexdigest()
    job = patiently(
        lambda: fold(
            row,
            events.read_states(attempt.connection, attempt.job_id),
            events.last_progress(attempt.connection, attempt.job_id),
        )
    )
    finished_at = now()
    ended = job.model_copy(
        update={
            "state": JobState.succeeded,
            "finished_at": finished_at,
            "model": attempt.job_id,
            "attempt": attempt.number,
        }
    )
    record = ended.model_dump(mode="json", exclude_none=True) | {
        "generation": attempt.generation,
        "format": FORMAT,
        "sha256": digests,
    }
    storage.put(layout.job_record(attempt.job_id), json.dumps(record, indent=1).encode())
    # A worker that is killed here leaves it to the server, which sees the end of the job.
    patiently(lambda: lists.add_model(attempt.connection, attempt.job_id, finished_at, row.owner))
