"""How the process of an attempt ended, and the sentence a person can act on."""

import os
import signal
from dataclasses import dataclass
from pathlib import Path
from resource import struct_rusage

from splatmill.schema import Problem, format_bytes
from splatmill_worker.service.attempt import HANDED_BACK, WITHDRAWN


@dataclass(frozen=True)
class Ending:
    """`status` is what wait(2) gave, peak_bytes the largest resident size, oom_kills how many processes the
    kernel killed for memory on this machine while the attempt ran."""

    status: int
    peak_bytes: int
    oom_kills: int

    @classmethod
    def of(cls, status: int, usage: struct_rusage, oom_kills: int) -> "Ending":
        return cls(status, usage.ru_maxrss * 1024, oom_kills)

    @property
    def clean(self) -> bool:
        return self.status == 0

    @property
    def handed_back(self) -> bool:
        return self._exit_code == HANDED_BACK

    @property
    def withdrawn(self) -> bool:
        return self._exit_code == WITHDRAWN

    @property
    def out_of_memory(self) -> bool:
        return self._signal == signal.SIGKILL and self.oom_kills > 0

    @property
    def _signal(self) -> int | None:
        return os.WTERMSIG(self.status) if os.WIFSIGNALED(self.status) else None

    @property
    def _exit_code(self) -> int | None:
        return os.WEXITSTATUS(self.status) if os.WIFEXITED(self.status) else None

    @property
    def cause(self) -> str:
        """What ended the process: `was killed by SIGSEGV`, `ran out of memory and was killed by the kernel`."""
        if self.out_of_memory:
            return "ran out of memory and was killed by the kernel"
        if self._signal is not None:
            return f"was killed by {signal.Signals(self._signal).name}"
        return f"ended with exit status {self._exit_code}"

    def problem(self, attempts: int) -> Problem:
        """The last word on a job whose processes died `attempts` times."""
        facts: dict[str, object] = {"attempts": attempts, "peak_memory_bytes": self.peak_bytes}
        if self._signal is not None:
            facts["signal"] = signal.Signals(self._signal).name
        else:
            facts["exit_status"] = self._exit_code
        seen = f"The job's process {self.cause} in each of its {attempts} attempts"
        if self.out_of_memory:
            return Problem.of(
                "out_of_memory",
                f"{seen}; it last held {format_bytes(self.peak_bytes)}.",
                facts=facts,
                advice="Set a smaller image_size, max_gaussians or max_memory, or use a machine with more memory.",
            )
        return Problem.of(
            "attempts_exhausted",
            f"{seen}.",
            facts=facts,
            advice="The worker's log says what it was doing. Restart the job once the cause is gone.",
        )


def oom_kills() -> int:
    """How many processes the kernel has killed for want of memory since boot; 0 where it does not count them."""
    try:
        lines = Path("/proc/vmstat").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith("oom_kill ")), 0)
