"""The pipeline of a simulated worker: the events and the files of a training, without one.

It runs in the attempt, as the engine does.
"""

import json
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from _one_gaussian import ply

from splatmill.schema import Event, JobState, MetricEvent, PlanEvent, ProgressEvent, StateEvent, TrainOptions

SCRIPT = "fleet.json"
"""Name of the image of a capture that names a file, `until`: a job on it trains until the file is there. Without one it
ends at once."""

STEP_SECONDS = 0.1
"""Seconds between two progress events of the pipeline; the outbox sends fewer of them."""

_PLAN = {f"decision_{number}": {"value": number, "reason": "x" * 40} for number in range(30)}
"""About 2 kB, as the plan of a training."""


def run(
    capture: Path,
    workdir: Path,
    options: TrainOptions,
    emit: Callable[[Event], None],
    cancelled: Callable[[], bool],
    *,
    onlookers: Any = None,
) -> Any:
    """Tell of a training until the capture says that it is over, and write its model."""
    until = json.loads((capture / "images" / SCRIPT).read_text())["until"]
    emit(StateEvent(state=JobState.sfm))
    emit(PlanEvent(plan=_PLAN))
    emit(StateEvent(state=JobState.training))
    step = 1
    emit(_progress(step))
    while until is not None and not Path(until).exists():
        time.sleep(STEP_SECONDS)
        step += 1
        emit(_progress(step))
    emit(MetricEvent(seconds=1.0, step=step, psnr=30.0, ssim=0.9, gaussians=1))
    emit(StateEvent(state=JobState.exporting))
    out = workdir / "out"
    out.mkdir(parents=True, exist_ok=True)
    (out / "model.ply").write_bytes(ply())
    (out / "report.json").write_text(json.dumps({"curve": [], "seconds": {}}))
    (out / "cameras.json").write_text(json.dumps({"cameras": []}))
    return SimpleNamespace(ended="succeeded")


def _progress(step: int) -> ProgressEvent:
    return ProgressEvent(stage="training", done=step, total=30_000, step=step, loss=0.05, gaussians=100_000)
