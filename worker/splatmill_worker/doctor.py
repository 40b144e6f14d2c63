"""`splatmill doctor`: checks whether Splatmill runs on this machine, and says what to do where it does not."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import shutil
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from splatmill.schema import format_bytes
from splatmill_worker import memory, settings

LOW_MEMORY = 2 << 30
"""Bytes of available memory below which small photos and few Gaussians are advised."""

LOW_DISK = 5 << 30
"""Bytes of free disk space below which more is advised."""

Verdict = Literal["ok", "warning", "bad"]
"""`bad`: Splatmill does not work on this machine. `warning`: it works, but slowly or with limits."""


@dataclass(frozen=True)
class Finding:
    """The result of a check.

    topic: what was checked.
    verdict: how it turned out.
    result: what the check showed.
    advice: what to do; empty where there is nothing to do.
    """

    topic: str
    verdict: Verdict
    result: str
    advice: str = ""


def run_checks() -> list[Finding]:
    """Run all checks in order and return their findings. An error inside a check becomes a finding."""
    findings: list[Finding] = []
    for check in (_python, _parts, _kernels, _threads, _memory, _disk, _redis, _storage, _decoders, _gpu):
        try:
            findings.extend(check())
        except Exception as error:  # the other checks still have to run
            failure = f"The check failed: {type(error).__name__}: {error}"
            findings.append(Finding(check.__name__.strip("_"), "bad", failure))
    return findings


def report(*, as_json: bool = False) -> int:
    """Run the checks and print their findings. Return 1 when one of them is bad, else 0."""
    findings = run_checks()
    if as_json:
        print(json.dumps([asdict(finding) for finding in findings], indent=1))
    else:
        width = max(len(finding.topic) for finding in findings)
        marks = {"ok": "ok  ", "warning": "note", "bad": "BAD "}
        for finding in findings:
            print(f"{marks[finding.verdict]}  {finding.topic:{width}}  {finding.result}")
            if finding.advice:
                print(f"{'':{width + 8}}-> {finding.advice}")
    return int(any(finding.verdict == "bad" for finding in findings))


def _python() -> Iterator[Finding]:
    old = sys.version_info < (3, 11)
    interpreter = f"{platform.python_version()} at {sys.executable}, {platform.platform()}"
    yield Finding(
        "python", "bad" if old else "ok", interpreter, "Splatmill needs Python 3.11 or newer." if old else ""
    )


def _parts() -> Iterator[Finding]:
    missing = []
    versions = []
    for name in (
        "splatmill",
        "splatmill-server",
        "splatmill-worker",
        "torch",
        "pycolmap",
        "opencv-python-headless",
        "av",
        "pillow-heif",
    ):
        try:
            versions.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            missing.append(name)
    yield Finding("parts", "ok", ", ".join(versions))
    if missing:
        lacking: Verdict = "bad" if set(missing) - {"splatmill-server"} else "warning"
        packages = " ".join(
            name.replace("splatmill-server", "'splatmill-server[embedded]'") for name in missing
        )
        advice = f"Install with `pip install {packages}`, in a source tree with `make install`."
        yield Finding("parts", lacking, f"not installed: {', '.join(missing)}", advice)
    pycolmap = importlib.import_module("pycolmap")
    yield Finding("colmap", "ok", f"{pycolmap.COLMAP_version}, CUDA {'yes' if pycolmap.has_cuda else 'no'}")


def _kernels() -> Iterator[Finding]:
    try:
        isa = importlib.import_module("splatmill_worker.kernels.cpu.isa")
        chosen = isa.chosen()
        isa.load(chosen)
    except (ImportError, RuntimeError) as error:
        yield Finding(
            "kernels",
            "bad",
            f"The compiled kernels cannot be loaded: {error}",
            "Reinstall the worker on a machine with a C++17 compiler, in a source tree with `make install`.",
        )
        return
    slow = chosen == "baseline"
    advice = (
        "The builds for AVX2 and AVX-512, which train several times as fast, are not used here."
        if slow
        else ""
    )
    yield Finding("kernels", "warning" if slow else "ok", f"cpu backend, {chosen} build", advice)


def _threads() -> Iterator[Finding]:
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limit = os.environ.get("OMP_NUM_THREADS")
    cores = f"{usable} of {os.cpu_count()} cores" + (f", OMP_NUM_THREADS={limit}" if limit else "")
    wasted = limit is not None and limit.isdigit() and int(limit) < usable
    yield Finding(
        "threads",
        "warning" if wasted else "ok",
        cores,
        "Unset OMP_NUM_THREADS to use all cores." if wasted else "",
    )


def _memory() -> Iterator[Finding]:
    import psutil

    now = psutil.virtual_memory()
    total, free = now.total, now.available
    limit = memory.group_limit()
    usable = min(free, limit) if limit else free
    amounts = f"{format_bytes(free)} free of {format_bytes(total)}"
    amounts += f", limited to {format_bytes(limit)} by the container" if limit and limit < total else ""
    low = usable < LOW_MEMORY
    advice = "Close other programs, or set a smaller image_size and max_memory." if low else ""
    yield Finding("memory", "warning" if low else "ok", amounts, advice)


def _disk() -> Iterator[Finding]:
    folder = settings.data_folder()
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    if not os.access(existing, os.W_OK):
        advice = "Set SPLATMILL_DATA to a folder that this user can write to."
        yield Finding("disk", "bad", f"This user cannot write to {existing}.", advice)
        return
    free = shutil.disk_usage(existing).free
    low = free < LOW_DISK
    advice = "Free disk space: a job stores its photos, their cameras and a checkpoint." if low else ""
    yield Finding("disk", "warning" if low else "ok", f"{format_bytes(free)} free for {folder}", advice)


def _decoders() -> Iterator[Finding]:
    from splatmill_worker.images.decoding.decoders import confined

    with confined([]) as decoders:
        lacking = decoders.lacking()
    if lacking:
        weakness = f"Photos are decoded in processes without secrets, but {lacking}"
        advice = (
            "Landlock and seccomp of Linux do that. Where photos come from strangers, run workers in "
            "containers, or as a user with no other rights."
        )
        yield Finding("decoders", "warning", weakness, advice)
    else:
        yield Finding(
            "decoders",
            "ok",
            "Photos are decoded in processes without secrets, network, files to write, or other files",
        )


def _redis() -> Iterator[Finding]:
    import redis

    from splatmill.backplane import memory, redis_program
    from splatmill.backplane.connection import connect
    from splatmill.backplane.redact import redacted

    if os.environ.get("REDIS_URL"):
        url = settings.redis_url()
        try:
            connection = connect(url, timeout=3, retries=0)
            server, trouble = connection.info("server"), memory.read(connection).trouble()
        except redis.RedisError as error:
            advice = "Start Redis there, or unset REDIS_URL, so that `splatmill up` starts its own."
            yield Finding("redis", "bad", f"Redis at {redacted(url)} cannot be reached: {error}", advice)
            return
        family = "valkey" if "valkey_version" in server else "redis"
        version = str(server[f"{family}_version"])
        yield Finding("redis", "ok", f"{family.capitalize()} {version} at {redacted(url)}")
        if trouble is not None:
            yield Finding("redis", "warning", *trouble)
        parsed = redis_program.parse_version(version)
    else:
        try:
            program = redis_program.find()
        except redis_program.NoRedisError as error:
            yield Finding("redis", "bad", str(error))
            return
        yield Finding("redis", "ok", f"{program}, which `splatmill up` starts")
        family, parsed = program.family, program.version
    if (fault := redis_program.lua_warning(family, parsed)) is not None:
        yield Finding("redis", "warning", *fault)


def _storage() -> Iterator[Finding]:
    from splatmill.backplane.redact import redacted
    from splatmill.backplane.storage.storage import Storage, StorageError

    url = settings.storage_url()
    if url.startswith("file:") and not os.environ.get("SPLATMILL_STORAGE"):
        yield Finding("storage", "ok", f"{url} (SPLATMILL_STORAGE is not set)")
        return
    try:
        Storage(url).check()
    except StorageError as error:
        yield Finding(
            "storage", "bad", str(error), "Check SPLATMILL_STORAGE, its credentials and their permissions."
        )
    else:
        yield Finding("storage", "ok", f"{redacted(url)}, writable")


def _gpu() -> Iterator[Finding]:
    device = importlib.import_module("splatmill_worker.kernels.gpu.device")
    why = device.absence()
    if why is not None:
        present = Path("/proc/driver/nvidia/version").exists()
        advice = (
            "An NVIDIA driver is installed, so there is probably a GPU that is not used." if present else ""
        )
        yield Finding("gpu", "warning" if present else "ok", f"Training runs on the CPU. {why}", advice)
        return
    facts = device.describe()
    yield Finding("gpu", "ok", f"{facts.name}, {format_bytes(facts.total_bytes)}")
