"""Following a job to its end, with Ctrl-C as one of the things that can arrive.

A signal that raised KeyboardInterrupt would strike between any two steps, also where a job has just been created or
a stream is half open. Here it is an item in the same queue as the events, and is dealt with where items are.
"""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from queue import SimpleQueue
from types import FrameType

from splatmill.cli.progress import Display, make_display, show
from splatmill.client import JobHandle, ModelHandle
from splatmill.errors import Conflict
from splatmill.schema import EventRecord

# timeout(1) and some supervisors send one wish to end twice, to the process and to its group.
ONE_WISH = 0.5  # seconds


@dataclass(frozen=True)
class Interruption:
    """Ctrl-C, or a polite end from outside (`kill`, a container that is stopped), at a monotonic time in seconds."""

    at: float


class Ended:
    """The job's events are over."""


Item = EventRecord | Interruption | Ended | Exception


class LeftBehind(Exception):
    """Interrupted twice: nobody waits for the cancellation any more."""


def follow(start: Callable[[], JobHandle], *, verbose: bool) -> ModelHandle:
    """Start a job and show it until its end; the first interruption cancels it, a second one stops waiting.

    Raises JobFailed, JobCancelled, LeftBehind, or what the SDK raises.
    """
    inbox: SimpleQueue[Item] = SimpleQueue()
    with _signals_into(inbox):
        job = start()
        _in_background(lambda: _listen(job, inbox))
        with make_display() as display:
            _until_ended(job, inbox, display, verbose)
        return job.result()


def _until_ended(job: JobHandle, inbox: SimpleQueue[Item], display: Display, verbose: bool) -> None:
    cancelling: Interruption | None = None
    while True:
        item = inbox.get()
        if isinstance(item, EventRecord):
            show(item, display, verbose=verbose)
        elif isinstance(item, Ended):
            return
        elif isinstance(item, Exception):
            raise item
        elif cancelling is not None:
            if item.at - cancelling.at > ONE_WISH:
                raise LeftBehind
        else:
            cancelling = item
            display.say(f"Cancelling the job {job.id} ...")
            _in_background(lambda: _cancel(job, inbox))


def _listen(job: JobHandle, inbox: SimpleQueue[Item]) -> None:
    try:
        for record in job.events():
            inbox.put(record)
        inbox.put(Ended())
    except Exception as error:
        inbox.put(error)


def _cancel(job: JobHandle, inbox: SimpleQueue[Item]) -> None:
    try:
        job.cancel()
    except Conflict:
        pass  # it ended meanwhile, and its events say how
    except Exception as error:
        inbox.put(error)


def _in_background(work: Callable[[], None]) -> None:
    threading.Thread(target=work, daemon=True).start()


@contextmanager
def _signals_into(inbox: SimpleQueue[Item]) -> Iterator[None]:
    def arrived(number: int, frame: FrameType | None) -> None:
        inbox.put(
            Interruption(time.monotonic())
        )  # SimpleQueue.put may be called at any point, also inside itself

    before = {number: signal.signal(number, arrived) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
