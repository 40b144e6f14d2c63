"""By how many bytes the memory of a process grows at most while it reads a file; on Linux only."""

from __future__ import annotations

import importlib
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from splatmill_worker.errors import WorkerError


def peaks(function: str, paths: list[Path]) -> list[tuple[int, str]]:
    """By how many bytes a new process grew that read each path but the first, and what refused it, or "read".

    function: as "module:function". The first path is read for what its reader imports.
    """
    command = [sys.executable, "-m", __name__, function, *map(str, paths)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=600)
    rows = [line.split("\t", 1) for line in done.stdout.splitlines()]
    assert len(rows) == len(paths) - 1, done.stderr
    return [(int(size), said) for size, said in rows]


def main() -> None:
    """Print the growth and the outcome of each file but the first."""
    module, _, name = sys.argv[1].partition(":")
    read = getattr(importlib.import_module(module), name)
    first, *paths = map(Path, sys.argv[2:])
    _tried(read, first)  # what it imports, and memory that it keeps
    for path in paths:
        Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
        before = _status("VmRSS")
        said = _tried(read, path)
        print(f"{_status('VmHWM') - before}\t{said}", flush=True)


def _tried(read: Callable[[Path], Any], path: Path) -> str:
    try:
        read(path)
    except (WorkerError, ValueError) as error:
        return str(error).replace("\n", " ")
    return "read"


def _status(name: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return 1024 * int(line.split()[1])
    raise KeyError(name)


if __name__ == "__main__":
    main()
