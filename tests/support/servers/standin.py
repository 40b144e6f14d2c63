"""A stand-in for the pipeline, with the same interface, which a test can slow down and crash at a chosen step.

It stores a checkpoint after each step and resumes from it, so that a test can tell a resumed attempt from a new one.
The capture's `images/script.json` controls it, or without one the environment variable STANDIN_SCRIPT:

    steps: number of steps, at most.
    until: file at whose appearance the steps end; without it, all are taken.
    pause: seconds per step.
    do, at: what happens (see `_act`), and at which step.
    gaussians: number of Gaussians of the model.
    diary: file to which each attempt appends its process, its first step, and whether another attempt ran beside it.
"""

import ctypes
import fcntl
import json
import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from splatmill.files import atomic_write
from splatmill.schema import (
    Event,
    JobState,
    LogEvent,
    MetricEvent,
    PlanEvent,
    PreviewEvent,
    ProgressEvent,
    StateEvent,
    TrainOptions,
)
from tests.support.ball import ball, write_ply


def run(
    capture: Path,
    workdir: Path,
    options: TrainOptions,
    emit: Callable[[Event], None],
    cancelled: Callable[[], bool],
    *,
    onlookers: object = None,
) -> SimpleNamespace:
    """Follow the script and leave a ball of Gaussians as the model. The photos are not read."""
    own = capture / "images" / "script.json"
    script = json.loads(own.read_text() if own.is_file() else os.environ["STANDIN_SCRIPT"])
    workdir.mkdir(parents=True, exist_ok=True)
    checkpoint = workdir / "checkpoints" / "state.json"
    diary = Path(script["diary"])
    # The kernel releases this lock when the process ends, not before: if it is held, two attempts run at once.
    alone = diary.with_suffix(".lock").open("w")
    try:
        fcntl.flock(alone, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        overlap = True
    else:
        overlap = False
    with diary.open("a") as file:
        line = {"pid": os.getpid(), "from": _step(checkpoint), "overlap": overlap}
        file.write(json.dumps(line) + "\n")
    emit(StateEvent(state=JobState.sfm))
    emit(ProgressEvent(stage="features", done=1, total=1))
    emit(StateEvent(state=JobState.training))
    emit(PlanEvent(plan={"steps": {"value": script["steps"], "because": "the script says so"}}))
    for step in range(_step(checkpoint) + 1, script["steps"] + 1):
        _act(script, step)
        time.sleep(script.get("pause", 0.0))
        _save(checkpoint, step)
        emit(ProgressEvent(stage="training", done=step, total=script["steps"], step=step, loss=1 / step))
        if cancelled():
            emit(LogEvent(message=f"saved at step {step}"))
            return SimpleNamespace(ended="cancelled")
        if "until" in script and Path(script["until"]).exists():
            break
    (workdir / "preview.jpg").write_bytes(b"\xff\xd8 no picture \xff\xd9")
    emit(PreviewEvent(path="preview.jpg", step=script["steps"]))
    emit(MetricEvent(seconds=1.0, step=script["steps"], psnr=30.0, ssim=0.9, gaussians=len(ball())))
    emit(StateEvent(state=JobState.exporting))
    out = workdir / "out"
    out.mkdir(exist_ok=True)
    write_ply(out / "model.ply", script.get("gaussians", 400))
    (out / "report.json").write_text(
        json.dumps({"curve": [{"seconds": 1.0, "step": 1, "psnr": 30.0, "gaussians": 100}], "seconds": {}})
    )
    (out / "cameras.json").write_text(json.dumps({"cameras": []}))
    return SimpleNamespace(ended="succeeded")


def _step(checkpoint: Path) -> int:
    return int(json.loads(checkpoint.read_text())["step"]) if checkpoint.is_file() else 0


def _save(checkpoint: Path, step: int) -> None:
    atomic_write(checkpoint, json.dumps({"step": step}))


def _allocate() -> None:
    """Take a gigabyte a second, ten of them at most."""
    kept = []
    for _ in range(100):
        kept.append(np.ones(100_000_000, dtype=np.uint8))
        time.sleep(0.1)


def _act(script: dict[str, object], step: int) -> None:
    """Do what the script says at its step; the step is not stored then, so that a later attempt does it again."""
    if script.get("at") != step:
        return
    match script.get("do"):
        case "raise":
            raise RuntimeError("the stand-in was told to fail")
        case "memory":
            raise MemoryError("the stand-in was told to run out of memory")
        case "segv":
            os.kill(os.getpid(), signal.SIGSEGV)
        case "kill worker":
            os.kill(os.getppid(), signal.SIGKILL)
            time.sleep(30)  # the kernel ends this process as well
        case "sleep":
            time.sleep(600)
        case "allocate":
            _allocate()
        case "allocate in a child":
            context = multiprocessing.get_context("fork")
            child = context.Process(target=_allocate)
            child.start()
            child.join()
        case "native":
            # One call that does not return to the interpreter, like a mapper's: it waits for what it holds itself.
            library, mutex = ctypes.CDLL(None), ctypes.create_string_buffer(256)
            library.pthread_mutex_init(mutex, None)
            library.pthread_mutex_lock(mutex)
            library.pthread_mutex_lock(mutex)
