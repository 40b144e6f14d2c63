"""The engine's pipeline in the jobs of a soak, with every begin, event, checkpoint and end on record.

It runs in the attempt's process (SPLATMILL_PIPELINE) and changes nothing of what the pipeline does. For a scene in
tiles, it replaces `tiles.job.run` by a function of its own. The record is one file of all attempts, SOAK_TRACE,
with a JSON line for each of

    begin: the process, the job, whether another attempt at the job runs beside it (`overlap`), and whether its model is
        in storage already (`published`);
    step: an event of the engine, with its `stage` and its `step` of the training where it has them;
    stored: the checkpoint of a step is stored;
    resume: training begins, behind the `step` of the checkpoint that was read, or 0;
    unit, unit stored: an attempt begins a `unit` of a scene in tiles, and has its output in storage. Tiles that a
        worker takes from the queue are not on record;
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
from splatmill_worker.pipeline.events import Emit
from splatmill_worker.settings import storage_url
from splatmill_worker.splat.train import checkpoint
from splatmill_worker.splat.train.snapshot import Snapshot
from splatmill_worker.tiles import job
from splatmill_worker.tiles.stages import Context, run_unit

run_tiles = job.run


def run(*arguments: Any, **more: Any) -> Any:
    """Run the pipeline, and record what becomes of it."""
    return _recorded(pipeline.run, *arguments, **more)


def run_in_tiles(capture: Path, workdir: Path, *arguments: Any, **more: Any) -> Any:
    """Do the units of a scene in tiles, and record what becomes of them."""
    name = workdir.parent.name

    def recorded_unit(context: Context) -> None:
        record(name, "unit", unit=context.run.name)
        run_unit(context)

    others = more["others"]
    stored = others.stored

    def recorded_stored(output: Path) -> None:
        stored(output)
        record(name, "unit stored", unit=output.name.rpartition("-")[0])  # NAME-DIGEST

    with patch.object(job, "run_unit", recorded_unit), patch.object(others, "stored", recorded_stored):
        return _recorded(run_tiles, capture, workdir, *arguments, **more)


def _recorded(
    work: Callable[..., Any],
    capture: Path,
    workdir: Path,
    options: TrainOptions,
    emit: Emit,
    cancelled: Callable[[], bool],
    **more: Any,
) -> Any:
    name = workdir.parent.name
    # The kernel releases this lock when the process ends, not before: if it is held, two attempts run at once.
    alone = open(Path(os.environ["SOAK_TRACE"]).parent / f"{name}.lock", "w")  # noqa: SIM115
    try:
        fcntl.flock(alone, fcntl.LOCK_EX | fcntl.LOCK_NB)
        overlap = False
    except BlockingIOError:
        overlap = True
    record(name, "begin", overlap=overlap, published=_published(name))
    save, load = checkpoint.save, checkpoint.load

    def recorded_emit(event: Event) -> None:
        record(name, "step", **_place(event))
        emit(event)

    def recorded_save(directory: Path, snapshot: Snapshot) -> None:
        save(directory, snapshot)
        record(name, "stored", step=snapshot.state.step)

    def recorded_load(directory: Path) -> Snapshot | None:
        snapshot = load(directory)
        record(name, "resume", step=0 if snapshot is None else snapshot.state.step)
        return snapshot

    with patch.multiple(checkpoint, save=recorded_save, load=recorded_load):
        result = work(capture, workdir, options, recorded_emit, cancelled, **more)
    if result.ended == "succeeded":
        record(name, "end")
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


job.run = run_in_tiles
