"""A small pipeline with the real one's contract, whose stages can be held, crashed and slowed from outside.

It checkpoints every step and goes on from there, so that a test can tell a resumed attempt from a new one. The
capture's `images/script.json` steers it: `steps` how many, `pause` seconds per step, `do` what `at` which step,
`gaussians` how many the model has. Each attempt writes into the `diary`, and whether another ran beside it.
"""

import fcntl
import json
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np

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
) -> SimpleNamespace:
    """Photos are not looked at; the model is a ball of Gaussians."""
    script = json.loads((capture / "images" / "script.json").read_text())
    workdir.mkdir(parents=True, exist_ok=True)
    checkpoint = workdir / "checkpoints" / "state.json"
    diary = Path(script["diary"])
    # The kernel drops this lock when the process is gone, not before: finding it held means two at once.
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
    checkpoint.parent.mkdir(exist_ok=True)
    part = checkpoint.with_suffix(".part")
    part.write_text(json.dumps({"step": step}))
    part.replace(checkpoint)


def _act(script: dict[str, object], step: int) -> None:
    """Fail at a step as the script asks: once per marker file, or each time."""
    if script.get("at") != step:
        return
    match script.get("do"):
        case "raise":
            raise RuntimeError("the stand-in was told to fail")
        case "memory":
            raise MemoryError("the stand-in was told to run out of memory")
        case "segv":
            os.kill(os.getpid(), signal.SIGSEGV)
        case "native":
            # One call that never comes back to the interpreter, as a mapper's does for seconds.
            np.linalg.svd(np.random.default_rng(0).normal(size=(6000, 6000)))
