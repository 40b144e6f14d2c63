"""Shows the events of a job until it ends. On Ctrl-C, it cancels the job or leaves it to be gone on with.

A KeyboardInterrupt could be raised between any two steps, for example when a job has just been created or while a
stream is opened. Therefore a signal is put into the same queue as the events, and handled where these are handled.
"""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from queue import Empty, SimpleQueue
from types import FrameType
from typing import TYPE_CHECKING

from splatmill.cli.display.progress import Display, make_display, show
from splatmill.errors import Conflict
from splatmill.schema import EventRecord, ProgressEvent, StateEvent

if TYPE_CHECKING:
    from splatmill.sdk.client import JobHandle, ModelHandle

SIGNAL_SECONDS = 0.25
"""Longest time for which a signal is not noticed. One that arrives just before a wait in C begins does not end it, nor
does one that another thread receives."""

ONE_SIGNAL_SECONDS = 0.5
"""Two signals within this time count as one: timeout(1) signals both the process and its group."""


@dataclass(frozen=True)
class Interruption:
    """SIGINT (Ctrl-C) or SIGTERM (`kill`, a container that is stopped). `at` is the monotonic time in seconds."""

    at: float


class EventsEnded:
    """The job has ended, and no more events follow."""


Item = EventRecord | Interruption | EventsEnded | Exception


class StoppedWaiting(Exception):
    """A second signal arrived: the command does not wait until the job is cancelled."""


class Interrupted(Exception):
    """A signal arrived that is not to cancel the job."""


def follow_job(
    start: "Callable[[], JobHandle]", *, verbose: bool, cancels: bool = True, since: datetime | None = None
) -> "ModelHandle":
    """Start a job, show its events until it ends, and return its model.

    cancels: the first signal (SIGINT or SIGTERM) cancels the job. Otherwise, it raises Interrupted.
    since: earlier events are not shown.

    Raises JobFailed, JobCancelled, Interrupted, StoppedWaiting after a second signal, and the errors of the SDK.
    """
    inbox: SimpleQueue[Item] = SimpleQueue()
    with _signals_into(inbox):
        job = start()
        _in_background(lambda: _read_events(job, inbox))
        with make_display() as display:
            _until_ended(job, inbox, display, verbose, cancels, since)
        return job.result()


def _until_ended(
    job: "JobHandle",
    inbox: SimpleQueue[Item],
    display: Display,
    verbose: bool,
    cancels: bool,
    since: datetime | None,
) -> None:
    cancelling: Interruption | None = None
    changed = datetime.min.replace(tzinfo=UTC)  # when the last state began
    while True:
        item = _next(inbox)
        if isinstance(item, EventRecord):
            if isinstance(item.event, StateEvent):
                changed = item.at
            # States and progress are two streams: the last progress of a state may be read after the next state.
            late = isinstance(item.event, ProgressEvent) and item.at < changed
            if not late and (since is None or item.at >= since):
                show(item, display, verbose=verbose)
        elif isinstance(item, EventsEnded):
            return
        elif isinstance(item, Exception):
            raise item
        elif not cancels:
            raise Interrupted
        elif cancelling is not None:
            if item.at - cancelling.at > ONE_SIGNAL_SECONDS:
                raise StoppedWaiting
        else:
            cancelling = item
            display.print(f"Cancelling the job {job.id} ...")
            _in_background(lambda: _cancel(job, inbox))


def _next(inbox: SimpleQueue[Item]) -> Item:
    """The next item; handlers of signals, which put items too, run at least every SIGNAL_SECONDS."""
    while True:
        with suppress(Empty):
            return inbox.get(timeout=SIGNAL_SECONDS)


def _read_events(job: "JobHandle", inbox: SimpleQueue[Item]) -> None:
    try:
        for record in job.events():
            inbox.put(record)
        inbox.put(EventsEnded())
    except Exception as error:
        inbox.put(error)


def _cancel(job: "JobHandle", inbox: SimpleQueue[Item]) -> None:
    try:
        job.cancel()
    except Conflict:
        pass  # the job has ended meanwhile; its events say how
    except Exception as error:
        inbox.put(error)


def _in_background(work: Callable[[], None]) -> None:
    threading.Thread(target=work, daemon=True).start()


@contextmanager
def _signals_into(inbox: SimpleQueue[Item]) -> Iterator[None]:
    def arrived(number: int, frame: FrameType | None) -> None:
        # SimpleQueue.put is reentrant, so a signal handler may call it at any point.
        inbox.put(Interruption(time.monotonic()))

    before = {number: signal.signal(number, arrived) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
