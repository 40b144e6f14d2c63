"""Which lines of the queue a worker serves: those that its operator names, or all that its machine can run."""

import subprocess
import sys
from pathlib import Path

from splatmill.backplane.queue.lines import LINES, Line

_DEVICES = ("nvidia[0-9]*", "nvidiactl", "dxg", "kfd")
"""Device files in /dev of which there is one where a driver of NVIDIA (also in WSL) or AMD is loaded."""

_ASK = "from splatmill_worker.kernels.gpu.device import absence; print(absence() or '')"
_ASK_SECONDS = 120.0
_ASKS = 3
"""Processes that ask, one after the other, where a signal ends them: without an answer, the worker would leave its GPU
unused for as long as it runs."""


class UnservedLines(ValueError):
    """The named lines cannot be served. The message says why, and what to do."""


def served_lines(named: str | None) -> tuple[Line, ...]:
    """Return the lines to serve.

    named: names separated by commas, from `--queues` or SPLATMILL_QUEUES; None or "": `any` and `cpu`, and `gpu` where
        the machine has a usable GPU.

    Raises UnservedLines for an unknown name, and for `gpu` where no GPU is usable.
    """
    names = [name.strip() for name in (named or "").split(",") if name.strip()]
    if unknown := sorted(set(names) - set(LINES)):
        raise UnservedLines(f"There is no queue {', '.join(unknown)}. The queues are {', '.join(LINES)}.")
    if names and "gpu" not in names:
        return tuple(line for line in LINES if line in names)
    reason = gpu_absence()
    if names and reason:
        raise UnservedLines(
            f"The queue gpu was requested, but this machine cannot serve it. {reason} Leave gpu out, or correct this."
        )
    return tuple(line for line in LINES if line in (names or LINES) and (line != "gpu" or not reason))


def gpu_absence() -> str:
    """Return why this machine has no usable GPU, or "". Another process asks: this one must not import torch."""
    if not any(any(Path("/dev").glob(pattern)) for pattern in _DEVICES):
        return "No driver of a GPU is loaded."
    try:
        for _ in range(_ASKS):
            asked = subprocess.run(
                [sys.executable, "-c", _ASK], capture_output=True, text=True, timeout=_ASK_SECONDS
            )
            if asked.returncode >= 0:
                break
    except subprocess.TimeoutExpired:
        return f"torch did not say within {_ASK_SECONDS:g} s whether it sees a GPU."
    if asked.returncode < 0:
        return f"torch could not be asked: the process that did was ended by signal {-asked.returncode}."
    if asked.returncode != 0:
        return f"torch could not be asked: {(asked.stderr.strip().splitlines() or ['it crashed'])[-1]}"
    return asked.stdout.strip()
