"""Progress of a job for people: a live bar on a terminal, plain lines elsewhere."""

import sys
import time
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol, Self

from splatmill.schema.events import (
    EventRecord,
    JobState,
    LogEvent,
    PlanEvent,
    Progress,
    ProgressEvent,
    StateEvent,
)
from splatmill.schema.quantities import format_bytes, format_duration

if TYPE_CHECKING:
    from rich.progress import TaskID

PLAIN_EVERY = 5.0  # seconds between lines of one stage, so that a log stays readable

STATES = {
    JobState.queued: "waiting for a worker",
    JobState.preparing: "preparing the photos",
    JobState.sfm: "recovering the cameras",
    JobState.training: "training",
    JobState.exporting: "writing the model",
}


def measurements(progress: Progress) -> str:
    """Loss, PSNR, Gaussians and ETA, those that there are."""
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
    """`120/3000`, as bytes while uploading."""
    show = format_bytes if progress.stage == "uploading" else str
    return show(progress.done) if progress.total is None else f"{show(progress.done)}/{show(progress.total)}"


def progress_text(progress: Progress) -> str:
    """One line of progress."""
    parts = [
        progress.stage,
        count_text(progress) if progress.done or progress.total else "",
        progress.note or "",
    ]
    return "  ".join(part for part in [*parts, measurements(progress)] if part)


class Display(Protocol):
    """Where progress goes."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def progress(self, progress: Progress) -> None:
        """Show how far things are."""

    def say(self, line: str) -> None:
        """Print a line that stays."""


class PlainDisplay:
    """Lines on standard output, at most one every few seconds per stage."""

    def __init__(self) -> None:
        self._stage = ""
        self._next = 0.0
        self._unsaid: Progress | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._last_word()

    def progress(self, progress: Progress) -> None:
        now = time.monotonic()
        if progress.stage != self._stage:
            self._last_word()
        elif now < self._next:
            self._unsaid = progress
            return
        self._stage, self._next, self._unsaid = progress.stage, now + PLAIN_EVERY, None
        print(progress_text(progress), flush=True)

    def say(self, line: str) -> None:
        self._last_word()
        print(line, flush=True)

    def _last_word(self) -> None:
        """A stage's last numbers are worth a line, however soon they came after the one before."""
        if self._unsaid is not None:
            print(progress_text(self._unsaid), flush=True)
            self._unsaid = None


class LiveDisplay:
    """One moving line on a terminal."""

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

    def say(self, line: str) -> None:
        self._bar.console.print(line, markup=False)


def make_display() -> Display:
    """A live one where standard output is a terminal."""
    return LiveDisplay() if sys.stdout.isatty() else PlainDisplay()


def show(record: EventRecord, display: Display, *, verbose: bool = False) -> None:
    """Show one event of a job."""
    event = record.event
    if isinstance(event, ProgressEvent):
        display.progress(event)
    elif isinstance(event, StateEvent) and event.state in STATES:
        again = (
            f" (attempt {record.attempt})" if record.attempt > 1 and event.state is JobState.preparing else ""
        )
        display.say(STATES[event.state] + again)
    # An error ends the job, whose problem is told at the end.
    elif isinstance(event, LogEvent) and (verbose or event.level == "warning"):
        display.say(f"{event.level}: {event.message}")
    elif isinstance(event, PlanEvent) and verbose:
        from splatmill.cli.plan import plan_lines

        for line in plan_lines(event.plan):
            display.say(f"plan: {line}")
