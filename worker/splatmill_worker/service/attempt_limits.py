"""The limits of an attempt, which its parent process watches: how long it may run, and how much memory it may use."""

import os
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from splatmill.schema import Problem, format_bytes, format_duration
from splatmill_worker import memory, settings

OOM_SCORE = 500
"""`oom_score_adj` of an attempt, of at most 1000, which its decoding processes have (`sandbox`). If the machine runs
out of memory, the kernel kills these first, unless the attempt has more than half of it, and the attempt before Redis,
the API and the worker itself, whose score is 0."""

_MEMORY_SECONDS = 0.5  # between two readings of the memory in use


@dataclass(frozen=True)
class Limits:
    """The limits of each attempt of a worker. None is no limit.

    run_seconds: how long it may run.
    memory_bytes: memory that all its processes may use together.
    """

    run_seconds: float | None = None
    memory_bytes: int | None = None

    @classmethod
    def from_settings(cls) -> "Limits":
        """Return the limits of the environment. Raises ValueError for values that cannot be read."""
        return cls(settings.max_run_time(), memory.attempt_limit())


@dataclass(frozen=True)
class RunTimeExceeded:
    """An attempt has run for too long."""

    limit_seconds: float

    def problem(self) -> Problem:
        """Return why the job failed, and what to do."""
        return Problem.of(
            "run_time_exceeded",
            f"The job ran for {format_duration(self.limit_seconds)}, which is the most that this worker allows, and "
            "was stopped.",
            facts={"limit_seconds": self.limit_seconds},
            advice="Restart the job to continue from its last checkpoint for as long again, or start one with a "
            "smaller time_budget or fewer steps. The operator sets the limit with SPLATMILL_MAX_RUN_TIME.",
        )


@dataclass(frozen=True)
class MemoryExceeded:
    """The processes of an attempt have used too much memory."""

    used_bytes: int
    limit_bytes: int

    def problem(self) -> Problem:
        """Return why the job failed, and what to do."""
        return Problem.of(
            "out_of_memory",
            f"The job used {format_bytes(self.used_bytes)} of memory, more than the {format_bytes(self.limit_bytes)} "
            "that this worker allows, and was stopped.",
            facts={"used_bytes": self.used_bytes, "limit_bytes": self.limit_bytes},
            advice="Set a smaller image_size, max_gaussians or max_memory, or use a machine with more memory. The "
            "operator sets the limit with SPLATMILL_MAX_MEMORY.",
        )


Exceeded = RunTimeExceeded | MemoryExceeded


class LimitWatch:
    """Watches one attempt from the moment at which it begins."""

    def __init__(self, limits: Limits, pid: int) -> None:
        self._limits = limits
        self._memory = memory.TreeMemory(pid)
        self._end = None if limits.run_seconds is None else time.monotonic() + limits.run_seconds
        self._look_at = 0.0

    def exceeded(self) -> Exceeded | None:
        """Return the limit that is exceeded, or None. It may be called at any rate."""
        now = time.monotonic()
        if (limit := self._limits.memory_bytes) is not None and now >= self._look_at:
            self._look_at = now + _MEMORY_SECONDS
            if (used := self._memory.used()) > limit:
                return MemoryExceeded(used, limit)
        if self._end is not None and now >= self._end:
            assert self._limits.run_seconds is not None
            return RunTimeExceeded(self._limits.run_seconds)
        return None


def die_first() -> None:
    """Have the kernel prefer this process, and those that it starts, when memory runs out."""
    path = Path(f"/proc/{os.getpid()}/oom_score_adj")
    with suppress(OSError, ValueError):  # not Linux, or hidden
        path.write_text(str(max(OOM_SCORE, int(path.read_text()))))
