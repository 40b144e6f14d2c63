"""The request to hand a job back: the worker is stopping, and the attempt saves its state and ends.

The worker requests it by a signal to the attempt's process. The pipeline polls `requested` and stores a checkpoint.
"""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

SIGNAL = signal.SIGUSR1
"""The signal that requests it. SIGTERM cannot serve: loading pycolmap replaces its handler by one that prints a stack
trace and ends the process."""

HANDLED = {signal.SIGTERM, signal.SIGINT, SIGNAL}
"""The signals that a worker and its attempts handle."""


class HandedBack(BaseException):
    """The attempt ends on request, and the job goes back to the queue."""


# A signal handler can interrupt any line of code, so it takes no lock and only sets a flag.
_requested = False


def requested() -> bool:
    """Return whether the worker has asked this attempt to save its state and end."""
    return _requested


def install_signal_handlers() -> None:
    """Set up the signals of an attempt's process: SIGNAL requests a hand-back and SIGTERM kills.

    SIGINT is ignored, because a terminal sends Ctrl-C to the worker as well, which then decides.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.signal(SIGNAL, _request)


def _request(signum: int, frame: FrameType | None) -> None:
    global _requested
    _requested = True


@contextmanager
def blocked_signals() -> Iterator[None]:
    """Keep the signals that a worker handles from this thread, and from the process that it forks, until the end of the
    block. Another thread may receive them meanwhile; the worker's handlers then run here all the same.
    """
    signal.pthread_sigmask(signal.SIG_BLOCK, HANDLED)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, HANDLED)
