"""A whole command with all processes that it starts: time, CPU seconds, largest memory, and the longest silence."""

from __future__ import annotations

import os
import subprocess
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import psutil
from _rows import worked

SAMPLED = 0.5
"""Seconds between two samples of the memory of a command's processes."""


@dataclass(frozen=True)
class Usage:
    """What a command took.

    status: its exit status.
    seconds: of wall time. cpu: seconds of it and of all processes that ended before it.
    memory: largest sum over its processes in bytes; a page that several of them share counts once.
    memory_after: the line that it had printed last by then.
    others: share of the machine's time that other programs had meanwhile.
    silence: longest time between two lines that it printed, in seconds, and the line before it.
    text: its last lines.
    """

    status: int
    seconds: float
    cpu: float
    memory: int
    memory_after: str
    others: float
    silence: tuple[float, str]
    text: str


def run(arguments: list[str], log: Path) -> Usage:
    """Run a command to its end. log: file that gets its output, each line behind the seconds since the start."""
    before, start = worked(), time.perf_counter()
    child = subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    memory = _Memory(child.pid)
    last, silence, tail = start, (0.0, ""), [""]
    assert child.stdout is not None
    with memory, log.open("w") as file, child.stdout as lines:
        for line in lines:
            now, line = time.perf_counter(), line.rstrip()
            silence = max(silence, (now - last, tail[-1]))
            last, tail = now, [*tail[-4:], line]
            memory.line = line
            print(f"{now - start:8.1f}  {line}", file=file, flush=True)
        _, status, use = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    seconds, cpu = time.perf_counter() - start, use.ru_utime + use.ru_stime
    others = max(0.0, worked() - before - cpu) / (seconds * (psutil.cpu_count() or 1))
    return Usage(
        child.returncode, seconds, cpu, memory.largest, memory.largest_after, others, silence, "\n".join(tail)
    )


class _Memory:
    """Watches a process and its descendants, in a thread, while the block runs.

    line: what it printed last. largest: most memory in bytes. largest_after: `line` at that time.
    """

    def __init__(self, pid: int) -> None:
        self.line, self.largest, self.largest_after = "", 0, ""
        self._root, self._ended = psutil.Process(pid), threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *raised: object) -> None:
        self._ended.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._ended.wait(SAMPLED):
            total = 0
            with suppress(psutil.Error):
                for process in (self._root, *self._root.children(recursive=True)):
                    with suppress(psutil.Error):  # it has ended meanwhile
                        total += process.memory_full_info().pss
            if total > self.largest:
                self.largest, self.largest_after = total, self.line
