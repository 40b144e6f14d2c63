"""Display of the progress of a job: a progress bar on a terminal, plain lines elsewhere."""

import sys
import threading
import time
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol, Self

from splatmill.schema.quantities import format_bytes, format_duration
from splatmill.schema.resources.jobs.events import (
    EventRecord,
    JobState,
    LogEvent,
    PlanEvent,
    Progress,
    ProgressEvent,
    StateEvent,
)

if TYPE_CHECKING:
    from rich.progress import TaskID

PLAIN_INTERVAL = 5.0  # seconds between two lines about one stage, so that a log stays readable

STATES = {
    JobState.queued: "waiting for a worker",
    JobState.preparing: "preparing the photos",
    JobState.sfm: "recovering the cameras",
    JobState.training: "training",
    JobState.exporting: "writing the model",
}


def measurements(progress: Progress) -> str:
    """Return loss, PSNR, number of Gaussians and ETA as text, as far as they are known."""
    parts = []
    if progress.loss is not None:
        parts.append(f"loss {progress.loss:.4f}")
    if progress.psnr is not None:
        parts.append(f"PSNR {progress.psnr:.2f} dB")
    if progress.gaussians is not None:
        parts.append(f"{progress.gaussians:,} Gaussians")
    if progress.eta is not None:
        parts.append(f"ETA {format_duration(max(progress.eta, 0.0))}")
    return "  ".join(parts)


def count_text(progress: Progress) -> str:
    """Return done and total as text: `120/3000`, or `1.5 MB/20.0 MB` for an upload."""
    show = format_bytes if progress.stage == "uploading" else str
    return show(progress.done) if progress.total is None else f"{show(progress.done)}/{show(progress.total)}"


def progress_text(progress: Progress) -> str:
    """Return progress as one line of text."""
    parts = [
        progress.stage,
        count_text(progress) if progress.done or progress.total else "",
        "or fewer, where more gain too little" if progress.at_most else "",
        progress.note or "",
    ]
    return "  ".join(part for part in [*parts, measurements(progress)] if part)


class Display(Protocol):
    """A display of the progress and the messages of a job."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def progress(self, progress: Progress) -> None:
        """Show the progress of a stage."""

    def print(self, line: str) -> None:
        """Print a line that stays on the screen."""


class PlainDisplay:
    """Prints lines to standard output, at most one every `interval` seconds about one stage, none twice in a row.

    Progress that came too soon after the line before is printed once the interval is over, if no other has come.
    """

    def __init__(self, interval: float = PLAIN_INTERVAL) -> None:
        self._interval = interval
        self._stage = ""
        self._next = 0.0
        self._last = ""
        self._held_back: Progress | None = None
        self._timer = threading.Timer(0.0, self._late)
        self._lock = threading.Lock()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._flush()

    def progress(self, progress: Progress) -> None:
        with self._lock:
            now = time.monotonic()
            if progress.stage != self._stage:
                self._flush()
            elif now < self._next:
                if self._held_back is None:
                    self._timer = threading.Timer(self._next - now, self._late)
                    self._timer.daemon = True
                    self._timer.start()
                self._held_back = progress
                return
            self._timer.cancel()
            self._stage, self._next, self._held_back = progress.stage, now + self._interval, None
            self._show(progress_text(progress))

    def print(self, line: str) -> None:
        with self._lock:
            self._flush()
            print(line, flush=True)

    def _late(self) -> None:
        """Print the progress that was held back, now that the interval is over."""
        with self._lock:
            self._next = time.monotonic() + self._interval
            self._flush()

    def _flush(self) -> None:
        """Print the last progress of a stage if it was held back for coming too soon after the line before."""
        self._timer.cancel()
        if self._held_back is not None:
            self._show(progress_text(self._held_back))
            self._held_back = None

    def _show(self, line: str) -> None:
        if line != self._last:
            print(line, flush=True)
        self._last = line


class LiveDisplay:
    """Shows a progress bar on a terminal."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, SpinnerColumn, TextColumn, TimeElapsedColumn
        from rich.progress import Progress as Bar

        self._bar = Bar(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[count]}", markup=False),
            TextColumn("{task.fields[measured]}", markup=False),
            TimeElapsedColumn(),
            console=Console(highlight=False),
            transient=True,
        )
        self._task: TaskID | None = None
        self._stage = ""

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def progress(self, progress: Progress) -> None:
        fields: dict[str, Any] = {"count": count_text(progress), "measured": measurements(progress)}
        if progress.stage != self._stage or self._task is None:
            if self._task is not None:
                self._bar.remove_task(self._task)
            self._stage = progress.stage
            self._task = self._bar.add_task(progress.stage, total=progress.total, **fields)
        self._bar.update(self._task, completed=progress.done, total=progress.total, **fields)

    def print(self, line: str) -> None:
        self._bar.console.print(line, markup=False)


def make_display() -> Display:
    """Return a progress bar if standard output is a terminal, else plain lines."""
    return LiveDisplay() if sys.stdout.isatty() else PlainDisplay()


def show(record: EventRecord, display: Display, *, verbose: bool = False) -> None:
    """Show an event of a job; log lines below a warning and the plan only if `verbose`."""
    event = record.event
    if isinstance(event, ProgressEvent):
        display.progress(event)
    elif isinstance(event, StateEvent) and event.state in STATES:
        again = (
            f" (attempt {record.attempt})" if record.attempt > 1 and event.state is JobState.preparing else ""
        )
        display.print(STATES[event.state] + again)
    # An error ends the job, and its problem is printed then.
    elif isinstance(event, LogEvent) and (verbose or event.level == "warning"):
        display.print(f"{event.level}: {event.message}")
    elif isinstance(event, PlanEvent) and verbose:
        from splatmill.cli.display.plan import plan_lines

        for line in plan_lines(event.plan):
            display.print(f"plan: {line}")
