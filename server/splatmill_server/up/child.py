"""One child of the embedded service: started, started anew when it dies, ended."""

import os
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

from splatmill.backplane.process import die_with_parent

_FIRST_PAUSE = 0.1
_LONGEST_PAUSE = 10.0
_STEADY = 30.0
"""Seconds a child must live for its next death to count as the first again."""


@dataclass
class Child:
    """`patience` is how many seconds it gets to end by itself; `at_death` the signal it gets when we die.

    It runs in a session of its own: Ctrl-C in the terminal reaches only the process that ends all in order.
    """

    name: str
    command: Sequence[str]
    environment: Mapping[str, str]
    open_log: Callable[[], int]
    patience: float
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
        """Start the process. Must be called from the main thread, with whose end the children end."""
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
        """How it ended, if it has; its next start is then due after a pause that grows with each early death."""
        if self._process is None or (code := self._process.poll()) is None:
            return None
        lived = time.monotonic() - self._began
        self._process = None
        self._pause = _FIRST_PAUSE if lived > _STEADY else min(2 * self._pause, _LONGEST_PAUSE)
        self.due = time.monotonic() + self._pause
        self.deaths += 1
        return f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit status {code}"

    def signal(self, sig: signal.Signals) -> None:
        if self._process is not None:
            with suppress(ProcessLookupError):
                self._process.send_signal(sig)

    def wait(self, seconds: float) -> bool:
        """Wait for its end; killed with all its own when it takes longer. False when it had to be killed."""
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
