"""The engine's pipeline in the jobs of a soak, with every begin, event, checkpoint and end on record.

It runs in the attempt's process (SPLATMILL_PIPELINE) and changes nothing of what the pipeline does. The record is one
file of all attempts, SOAK_TRACE, with a JSON line for each of

    begin: the process, the job, whether another attempt at the job runs beside it (`overlap`), and whether its model is
        in storage already (`published`);
    step: an event of the engine, with its `stage` and its `step` of the training where it has them;
    stored: the checkpoint of a step is stored;
    resume: training begins, behind the `step` of the checkpoint that was read, or 0;
    end: the pipeline has returned with a whole model.

Times are those of the machine's monotonic clock, which all processes share and no fault of a soak sets.
"""

import fcntl
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage, StorageError
from splatmill.schema import Event, ProgressEvent, StateEvent, TrainOptions
from splatmill_worker import pipeline
from splatmill_worker.settings import storage_url
from splatmill_worker.splat.train import checkpoint
from splatmill_worker.splat.train.snapshot import Snapshot


def run(
    capture: Path,
    workdir: Path,
    options: TrainOptions,
    emit: Callable[[Event], None],
    cancelled: Callable[[], bool],
    *,
    onlookers: Any = None,
) -> Any:
    """Run the pipeline, and record what becomes of it."""
    job = workdir.parent.name
    # The kernel releases this lock when the process ends, not before: if it is held, two attempts run at once.
    alone = open(Path(os.environ["SOAK_TRACE"]).parent / f"{job}.lock", "w")  # noqa: SIM115
    try:
        fcntl.flock(alone, fcntl.LOCK_EX | fcntl.LOCK_NB)
        overlap = False
    except BlockingIOError:
        overlap = True
    record(job, "begin", overlap=overlap, published=_published(job))
    save, load = checkpoint.save, checkpoint.load

    def recorded_emit(event: Event) -> None:
        record(job, "step", **_place(event))
        emit(event)

    def recorded_save(directory: Path, snapshot: Snapshot) -> None:
        save(directory, snapshot)
        record(job, "stored", step=snapshot.state.step)

    def recorded_load(directory: Path) -> Snapshot | None:
        snapshot = load(directory)
        record(job, "resume", step=0 if snapshot is None else snapshot.state.step)
        return snapshot

    with patch.multiple(checkpoint, save=recorded_save, load=recorded_load):
        result = pipeline.run(capture, workdir, options, recorded_emit, cancelled, onlookers=onlookers)
    if result.ended == "succeeded":
        record(job, "end")
    return result


def record(job: str, what: str, **more: Any) -> None:
    """Append a line to the record in one write, which no kill can cut."""
    line = {"at": time.monotonic(), "job": job, "pid": os.getpid(), "what": what, **more}
    handle = os.open(os.environ["SOAK_TRACE"], os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        os.write(handle, json.dumps(line).encode() + b"\n")
    finally:
        os.close(handle)


def _place(event: Event) -> dict[str, Any]:
    if isinstance(event, ProgressEvent):
        return {"stage": event.stage, "step": event.step}
    if isinstance(event, StateEvent):
        return {"stage": event.state.value, "step": None}
    return {"stage": None, "step": None}


def _published(job: str) -> bool:
    """Return whether the model of this job is stored, as far as storage answers."""
    try:
        return Storage(storage_url()).exists(layout.job_record(job))
    except StorageError:
        return False
