"""A child process of the embedded service, which is restarted when it dies."""

import os
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

from splatmill.process import die_with_parent

_FIRST_PAUSE = 0.1  # seconds
_LONGEST_PAUSE = 10.0  # seconds
_STEADY_SECONDS = 30.0
"""Run time after which the pause before the next restart is the shortest one again."""


@dataclass
class Child:
    """A child process. It runs in its own session, so that Ctrl-C in a terminal reaches only the supervisor.

    name: for messages and the log file.
    command: program and arguments.
    environment: all environment variables.
    open_log: returns a file descriptor for its output.
    stop_seconds: time for it to end after a signal, before it is killed.
    at_death: signal that it receives when the supervisor dies.
    inherited: file descriptors that it inherits.
    deaths: how often it has died.
    due: monotonic time at which it is to be started; None while it runs, or is not needed yet.
    """

    name: str
    command: Sequence[str]
    environment: Mapping[str, str]
    open_log: Callable[[], int]
    stop_seconds: float
    at_death: signal.Signals = signal.SIGKILL
    inherited: tuple[int, ...] = ()
    deaths: int = 0
    due: float | None = field(default=0.0)
    _process: subprocess.Popen[bytes] | None = None
    _began: float = 0.0
    _pause: float = _FIRST_PAUSE

    @property
    def running(self) -> bool:
        return self._process is not None

    @property
    def pid(self) -> int | None:
        return self._process.pid if self._process else None

    def start(self) -> None:
        """Start the process. Call this in the main thread, because the child dies with the thread that forks it."""
        parent = os.getpid()
        log = self.open_log()
        try:
            self._process = subprocess.Popen(
                self.command,
                env=self.environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                pass_fds=self.inherited,
                start_new_session=True,
                preexec_fn=lambda: die_with_parent(parent, self.at_death),
            )
        finally:
            os.close(log)
        self._began = time.monotonic()
        self.due = None

    def reap(self) -> str | None:
        """Return how the process ended, or None while it runs. It is due after a pause, longer for early deaths."""
        if self._process is None or (code := self._process.poll()) is None:
            return None
        lived = time.monotonic() - self._began
        self._process = None
        self._pause = _FIRST_PAUSE if lived > _STEADY_SECONDS else min(2 * self._pause, _LONGEST_PAUSE)
        self.due = time.monotonic() + self._pause
        self.deaths += 1
        return f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit status {code}"

    def signal(self, sig: signal.Signals) -> None:
        if self._process is not None:
            with suppress(ProcessLookupError):
                self._process.send_signal(sig)

    def wait(self, seconds: float) -> bool:
        """Wait for the process to end, and kill its process group after `seconds`; return False if it was killed."""
        if self._process is None:
            return True
        try:
            self._process.wait(max(seconds, 0.0))
            return True
        except subprocess.TimeoutExpired:
            with suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
            return False
        finally:
            self._process = None
            self.due = None
