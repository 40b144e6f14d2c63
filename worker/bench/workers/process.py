"""A process that does units of a plan, and what it printed when."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

BEGINS = ": begins"
"""What the program prints behind the name of a unit that it begins."""


@dataclass
class Worker:
    """A running `splatmill unit PLAN`, in a process group of its own.

    plan: folder of the plan.
    threads: of its kernels.
    begun: units in the order in which it began them, each with the time.
    """

    plan: Path
    threads: int
    begun: list[tuple[str, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.start = time.perf_counter()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "splatmill_worker", "unit", str(self.plan)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": str(self.threads)},
            start_new_session=True,
        )
        self.lines: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.lines.append(line.rstrip())
            if line.rstrip().endswith(BEGINS):
                self.begun.append((line.rstrip().removesuffix(BEGINS), time.perf_counter()))

    @property
    def runs(self) -> bool:
        """Whether it has not ended."""
        return self._process.poll() is None

    def send(self, number: signal.Signals) -> None:
        """Send a signal to it and to the process that does its units."""
        if self.runs:
            os.killpg(self._process.pid, number)

    def wait(self) -> int:
        """Wait for its end; returns the exit status."""
        status = self._process.wait()
        self._reader.join()
        return status
