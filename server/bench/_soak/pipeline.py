"""The pipeline of the jobs of a soak: the engine's or steps without photos, with every begin, step and end on record.

It runs in the attempt's process (SPLATMILL_PIPELINE). The record is one file of all attempts, SOAK_TRACE, with a JSON
line for each of

    begin: the process, the job, the step that it resumes from, whether another attempt at the job runs beside it
        (`overlap`), and whether its model is in storage already (`published`);
    step: a step whose checkpoint is stored (`stored`), or any event of the engine;
    end: the pipeline has returned with a whole model.

Times are those of the machine's monotonic clock, which all processes share and no fault of a soak sets.
"""

import fcntl
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from _one_gaussian import ply

from splatmill.backplane import layout
from splatmill.backplane.storage import Storage, StorageError
from splatmill.files import atomic_write
from splatmill.schema import Event, JobState, MetricEvent, PlanEvent, ProgressEvent, StateEvent, TrainOptions
from splatmill_worker.settings import storage_url

SCRIPT = "soak.json"
"""Name of the image of a capture that is no photo: a job on it takes the steps that it lists, without the engine."""


def run(
    capture: Path,
    workdir: Path,
    options: TrainOptions,
    emit: Callable[[Event], None],
    cancelled: Callable[[], bool],
    *,
    onlookers: Any = None,
) -> Any:
    """Run the job that the capture asks for, and record what becomes of it."""
    workdir.mkdir(parents=True, exist_ok=True)
    job = workdir.parent.name
    # The kernel releases this lock when the process ends, not before: if it is held, two attempts run at once.
    alone = open(Path(os.environ["SOAK_TRACE"]).parent / f"{job}.lock", "w")  # noqa: SIM115
    try:
        fcntl.flock(alone, fcntl.LOCK_EX | fcntl.LOCK_NB)
        overlap = False
    except BlockingIOError:
        overlap = True
    script = capture / "images" / SCRIPT
    if script.is_file():
        record(job, "begin", overlap=overlap, published=_published(job), step=_step(workdir))
        result: Any = _steps(json.loads(script.read_text()), job, workdir, emit, cancelled)
    else:
        record(job, "begin", overlap=overlap, published=_published(job), step=None)

        def noted(event: Event) -> None:
            record(job, "step", step=event.step if isinstance(event, ProgressEvent) else None)
            emit(event)

        from splatmill_worker import pipeline

        result = pipeline.run(capture, workdir, options, noted, cancelled, onlookers=onlookers)
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


def _steps(
    script: dict[str, Any],
    job: str,
    workdir: Path,
    emit: Callable[[Event], None],
    cancelled: Callable[[], bool],
) -> SimpleNamespace:
    """Take the script's `steps`, of `seconds` each, with a checkpoint of `bytes` after every one."""
    total = int(script["steps"])
    emit(StateEvent(state=JobState.sfm))
    emit(StateEvent(state=JobState.training))
    emit(PlanEvent(plan={"steps": {"value": total, "because": "the script says so"}}))
    for step in range(_step(workdir) + 1, total + 1):
        time.sleep(script["seconds"])
        text = json.dumps({"step": step, "padding": "x" * int(script["bytes"])})
        atomic_write(_checkpoint(workdir), text)
        record(job, "step", step=step, stored=True)
        emit(ProgressEvent(stage="training", done=step, total=total, step=step, loss=1 / step))
        if cancelled():
            return SimpleNamespace(ended="cancelled")
    emit(MetricEvent(seconds=1.0, step=total, psnr=30.0, ssim=0.9, gaussians=script["gaussians"]))
    emit(StateEvent(state=JobState.exporting))
    out = workdir / "out"
    out.mkdir(exist_ok=True)
    (out / "model.ply").write_bytes(ply(int(script["gaussians"])))
    curve = [{"seconds": 1.0, "step": total, "psnr": 30.0, "gaussians": script["gaussians"]}]
    (out / "report.json").write_text(json.dumps({"curve": curve, "seconds": {}}))
    (out / "cameras.json").write_text(json.dumps({"cameras": []}))
    return SimpleNamespace(ended="succeeded")


def _published(job: str) -> bool:
    """Return whether the model of this job is stored, as far as storage answers."""
    try:
        return Storage(storage_url()).exists(layout.job_record(job))
    except StorageError:
        return False


def _checkpoint(workdir: Path) -> Path:
    return workdir / "checkpoints" / "state.json"


def _step(workdir: Path) -> int:
    path = _checkpoint(workdir)
    return int(json.loads(path.read_text())["step"]) if path.is_file() else 0
