"""Turns what structure from motion and training report into the events of a job."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from splatmill.schema import Event, LogEvent, MetricEvent, PreviewEvent, ProgressEvent
from splatmill_worker.pipeline.remaining import StagePace
from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.picture import save_jpeg
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.train.curve import CurvePoint
from splatmill_worker.splat.train.observers import TrainingProgress
from splatmill_worker.splat.train.renderer import render_view
from splatmill_worker.splat.views import TrainingView

Emit = Callable[[Event], None]


def progress_events(emit: Emit) -> Callable[[str, int, int, str], None]:
    """A callback (stage, done, total, note) that emits each call as a progress event, with its seconds left."""
    paces: dict[str, StagePace] = {}

    def emit_progress(stage: str, done: int, total: int, note: str) -> None:
        now = time.monotonic()
        pace = paces.setdefault(stage, StagePace(now))
        pace.add(done, now)
        left = pace.remaining(total)
        emit(ProgressEvent(stage=stage, done=done, total=total or None, note=note or None, eta=left))

    return emit_progress


class TrainingEvents:
    """Emits the progress, metrics and warnings of a training run, and keeps its preview picture up to date.

    emit: called with each event.
    workdir: folder of the run; the preview is written to out/preview.jpg in it.
    plan: how the preview is rendered.
    view: the view that the preview shows.
    warnings: the messages of all warnings so far.
    """

    def __init__(self, emit: Emit, workdir: Path, plan: Plan, view: TrainingView) -> None:
        self._emit, self._workdir, self._plan, self._view = emit, workdir, plan, view
        self._emit_progress = progress_events(emit)
        self._last: CurvePoint | None = None
        self.warnings: list[str] = []

    def progress(self, progress: TrainingProgress) -> None:
        """Emit how far the run is, with the last measured PSNR and SSIM."""
        self._emit(
            ProgressEvent(
                stage="training",
                done=progress.step,
                total=progress.steps,
                step=progress.step,
                loss=progress.loss,
                psnr=None if self._last is None else self._last.psnr,
                ssim=None if self._last is None else self._last.ssim,
                gaussians=progress.gaussians,
                seconds=progress.seconds,
                eta=progress.eta,
                at_most=progress.at_most or None,
            )
        )

    def evaluating(self, done: int, total: int, note: str = "photos compared with the scene") -> None:
        """Emit how many photos the finished scene was compared with, or what else was."""
        self._emit_progress("evaluation", done, total, note)

    def writing(self, what: str) -> None:
        """Emit which of the files of the model are written now."""
        self._emit(ProgressEvent(stage="writing", note=what))

    def evaluated(self, point: CurvePoint, engine: Engine) -> None:
        """Emit the metrics of an evaluation, and render the preview anew."""
        self._last = point
        self._emit(
            MetricEvent(
                seconds=point.seconds,
                step=point.step,
                loss=point.loss,
                psnr=point.psnr,
                ssim=point.ssim,
                gaussians=point.gaussians,
                memory=point.memory,
                train_psnr=point.train_psnr,
                train_ssim=point.train_ssim,
            )
        )
        self.preview(engine, point.step)

    def warn(self, message: str) -> None:
        """Emit a warning, and keep it for the report."""
        self.warnings.append(message)
        self._emit(LogEvent(level="warning", message=message))

    def preview(self, engine: Engine, step: int) -> None:
        """Render the preview from the engine's present Gaussians, write it, and emit its path."""
        color = render_view(engine, self._plan, self._view)
        save_jpeg(self._workdir / "out" / "preview.jpg", color)
        self._emit(PreviewEvent(path="out/preview.jpg", step=step))
