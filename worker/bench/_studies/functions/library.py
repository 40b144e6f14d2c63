"""Counts the errors of the kernels' functions: builds functions.cpp for each instruction set, and calls it."""

from __future__ import annotations

import ctypes
import fcntl
import math
import os
import subprocess
import sys
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import torch

from .spans import BINS, Function, runs

WORKER = Path(__file__).resolve().parents[3]
BUILD = WORKER / "build" / "functions"


class Errors(ctypes.Structure):
    """Errors of many results: the struct of the same name in functions.cpp."""

    _fields_ = (
        ("count", ctypes.c_int64),
        ("rounded", ctypes.c_int64),
        ("ulp", ctypes.c_double),
        ("relative", ctypes.c_double),
        ("absolute", ctypes.c_double),
        ("ulp_squares", ctypes.c_double),
        ("relative_sum", ctypes.c_double),
        ("at_ulp", ctypes.c_uint32),
        ("at_relative", ctypes.c_uint32),
        ("at_absolute", ctypes.c_uint32),
    )

    def add(self, other: Errors) -> None:
        """Take in the errors of other inputs."""
        for field in ("count", "rounded", "ulp_squares", "relative_sum"):
            setattr(self, field, getattr(self, field) + getattr(other, field))
        for field in ("ulp", "relative", "absolute"):
            if getattr(other, field) > getattr(self, field):
                setattr(self, field, getattr(other, field))
                setattr(self, f"at_{field}", getattr(other, f"at_{field}"))


@cache
def load(build: str) -> ctypes.CDLL:
    """The library for one instruction set, built with the flags of the engine. Raises RuntimeError where that fails."""
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}

    def cmake(*arguments: str) -> None:
        done = subprocess.run(
            ["cmake", *arguments], env=environment, capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise RuntimeError(
                f"cmake {' '.join(arguments)} failed:\n{done.stdout[-2000:]}{done.stderr[-2000:]}"
            )

    BUILD.mkdir(parents=True, exist_ok=True)
    with (BUILD / "lock").open("w") as lock:  # tests may build from two processes
        fcntl.flock(lock, fcntl.LOCK_EX)
        cmake(
            "-G", "Ninja", "-S", str(WORKER), "-B", str(BUILD), "-DCMAKE_BUILD_TYPE=Release",
            "-DSPLATMILL_FUNCTIONS=ON", f"-DPython_EXECUTABLE={sys.executable}",
        )  # fmt: skip
        cmake("--build", str(BUILD), "--target", f"functions_{build}")
    library = ctypes.CDLL(str(BUILD / f"functions_{build}.so"))
    library.add_errors.argtypes = [
        ctypes.c_char_p, ctypes.c_uint32, ctypes.c_int64, ctypes.c_uint32, ctypes.POINTER(Errors),
    ]  # fmt: skip
    library.add_errors.restype = ctypes.c_bool
    library.unlike_octaves.argtypes = [ctypes.c_char_p, ctypes.c_int, ctypes.c_int, ctypes.c_int]
    library.unlike_octaves.restype = ctypes.c_int64
    library.exact.argtypes = [ctypes.c_char_p, ctypes.c_double]
    library.exact.restype = ctypes.c_double
    return library


def errors(library: ctypes.CDLL, function: str, ranges: Iterable[tuple[int, int]], stride: int = 1) -> Errors:
    """The errors at every stride-th float of ranges of places."""
    totals = Errors()
    for first, end in ranges:
        for bits, count in runs(first, end, stride):
            if not library.add_errors(function.encode(), bits, count, stride, ctypes.byref(totals)):
                raise ValueError(f"functions.cpp has no function {function!r}")
    return totals


def measure(build: str, function: Function, stride: int = 1) -> dict[str, Any]:
    """A row: the largest and mean errors over a function's arguments, and the largest of each of `BINS` parts of them.

    With a stride of 1, the other octaves are compared with those of the span too.
    """
    library = load(build)
    parts = function.span.parts(BINS)
    with ThreadPoolExecutor(torch.get_num_threads()) as threads:
        each = list(threads.map(lambda part: errors(library, function.name, [part], stride), parts))
    total = Errors()
    for one in each:
        total.add(one)
    row: dict[str, Any] = {
        "bench": "functions", "function": function.name, "build": build, "arguments": function.span.label,
        "count": total.count, "rounded": total.rounded / total.count,
        "rms_ulp": math.sqrt(total.ulp_squares / total.count), "mean_relative": total.relative_sum / total.count,
    }  # fmt: skip
    for field in ("ulp", "relative", "absolute"):
        row |= {field: getattr(total, field), f"{field}_bits": getattr(total, f"at_{field}")}
    octaves = function.octaves
    if octaves is not None and stride == 1:
        row["octaves"] = octaves.label
        row["unlike"] = library.unlike_octaves(
            function.name.encode(), octaves.first, octaves.last, octaves.power
        )
    return {**row, "bins": [round(one.ulp, 4) for one in each]}
