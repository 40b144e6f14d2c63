"""How the process of an attempt exited, and the problem that describes it to a user."""

import os
import signal
from dataclasses import dataclass
from pathlib import Path
from resource import struct_rusage

from splatmill.schema import Problem, format_bytes

HANDED_BACK_STATUS = 75
"""Exit status (EX_TEMPFAIL) of an attempt that saved its state because the worker is stopping."""

UNREPORTED_STATUS = 76
"""Exit status of an attempt that gave up waiting for Redis. Its files are kept, so that the next attempt continues."""

WITHDRAWN_STATUS = 77
"""Exit status of an attempt whose job was cancelled before it began, and of a tile that its job needs no longer."""


@dataclass(frozen=True)
class ProcessExit:
    """How a process exited.

    wait_status: the status that wait(2) returned.
    peak_bytes: largest resident set size of the process, bytes.
    oom_kills: number of processes on this machine that the kernel killed for memory while the process ran.
    """

    wait_status: int
    peak_bytes: int
    oom_kills: int

    @classmethod
    def of(cls, wait_status: int, usage: struct_rusage, oom_kills: int) -> "ProcessExit":
        """Return the exit that wait4(2) reported. `usage.ru_maxrss` is in KiB."""
        return cls(wait_status, usage.ru_maxrss * 1024, oom_kills)

    @property
    def clean(self) -> bool:
        """Whether the exit status is 0: the attempt itself reported how it ended."""
        return self.wait_status == 0

    @property
    def handed_back(self) -> bool:
        """Whether the attempt saved its state and ended on request."""
        return self._exit_status == HANDED_BACK_STATUS

    @property
    def unreported(self) -> bool:
        """Whether the attempt gave up waiting for Redis."""
        return self._exit_status == UNREPORTED_STATUS

    @property
    def withdrawn(self) -> bool:
        """Whether the process found that its job needs it no longer."""
        return self._exit_status == WITHDRAWN_STATUS

    @property
    def out_of_memory(self) -> bool:
        """Whether the kernel probably killed the process because memory ran out."""
        return self._signal == signal.SIGKILL and self.oom_kills > 0

    @property
    def cause(self) -> str:
        """The predicate of a sentence: "was killed by SIGSEGV", "exited with status 1"."""
        if self.out_of_memory:
            return "ran out of memory and was killed by the kernel"
        if self._signal is not None:
            return f"was killed by {self._signal.name}"
        return f"exited with status {self._exit_status}"

    def problem(self, attempts: int) -> Problem:
        """Return the problem of a job whose process exited in this way, in the last of `attempts` attempts."""
        facts: dict[str, object] = {"attempts": attempts, "peak_memory_bytes": self.peak_bytes}
        if self._signal is not None:
            facts["signal"] = self._signal.name
        else:
            facts["exit_status"] = self._exit_status
        detail = f"All {attempts} attempts ended early. In the last one, the job's process {self.cause}"
        if self.out_of_memory:
            return Problem.of(
                "out_of_memory",
                f"{detail}. Its peak memory was {format_bytes(self.peak_bytes)}.",
                facts=facts,
                advice="Set a smaller image_size, max_gaussians or max_memory, or use a machine with more memory.",
            )
        return Problem.of(
            "attempts_exhausted",
            f"{detail}.",
            facts=facts,
            advice="Look for the cause in the worker's log, correct it, and restart the job.",
        )

    @property
    def _signal(self) -> signal.Signals | None:
        return signal.Signals(os.WTERMSIG(self.wait_status)) if os.WIFSIGNALED(self.wait_status) else None

    @property
    def _exit_status(self) -> int | None:
        return os.WEXITSTATUS(self.wait_status) if os.WIFEXITED(self.wait_status) else None


def oom_kill_count() -> int:
    """Return how many processes the kernel has killed for memory since boot; 0 where it keeps no count."""
    try:
        lines = Path("/proc/vmstat").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith("oom_kill ")), 0)
