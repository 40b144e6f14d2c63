"""The machine and the software that a report was made with."""

from __future__ import annotations

import os
import platform
import resource
from importlib import metadata
from pathlib import Path
from typing import Any

import psutil
import torch

PACKAGES = ("splatmill", "splatmill-worker", "torch", "pycolmap", "opencv-python-headless", "numpy")


def machine() -> dict[str, Any]:
    """Processor, usable cores, memory in bytes and GPU (None without one): what times depend on."""
    return {
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "memory": psutil.virtual_memory().total,
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }


def versions(kernels: str) -> dict[str, Any]:
    """Versions of Python and of the packages that compute, and the backend `kernels` that was used."""
    record: dict[str, Any] = {"python": platform.python_version(), "backend": kernels}
    for package in PACKAGES:
        try:
            record[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            record[package] = None
    if kernels == "cpu":
        from splatmill_worker.kernels.cpu import isa

        record["instruction_set"] = isa.chosen()
    return record


def peak_memory() -> int:
    """Largest resident size of this process so far, in bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if platform.system() == "Darwin" else 1024 * peak


def resident_memory() -> int:
    """Resident size of this process now, in bytes."""
    return int(psutil.Process().memory_info().rss)


def _processor() -> str:
    """The processor's model name from Linux, or what Python knows of it elsewhere."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
