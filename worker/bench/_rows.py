"""Rows of a benchmark: JSON lines that carry the commit, machine and versions they were measured with."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from argparse import ArgumentTypeError
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import torch

HERE = Path(__file__).resolve().parent
Row = dict[str, Any]


@cache
def origin(*parts: str) -> Row:
    """Commit, machine and versions. A + behind the commit says that the tree had changes that were not committed: that
    of the worker, and of the other `parts` of the repository that are measured."""

    def git(*arguments: str) -> str:
        return subprocess.run(
            ["git", *arguments], cwd=HERE, capture_output=True, text=True, check=False
        ).stdout.strip()

    # Rows and what is drawn from them are the outcome, not what is measured.
    sources = ("..", *(f"../../{part}" for part in parts), ":(exclude,glob,top)**/bench/**/results/**")
    sources += (":(exclude,glob,top)**/bench/**/figures/**", ":(exclude,top)*.md")
    commit = git("rev-parse", "--short", "HEAD") + (
        "+" if git("status", "--porcelain", "--", *sources) else ""
    )
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [
            x.split(":")[1].strip() for x in cpuinfo.read_text().splitlines() if x.startswith("model name")
        ]
        model = names[0] if names else model
    versions = {"python": platform.python_version(), "torch": torch.__version__}
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    try:
        from splatmill_worker.kernels.cpu import isa

        build = isa.chosen()
    except ImportError:  # a machine where only the GPU is measured: the C++ is not built there
        build = "no CPU kernels"
    return {"commit": commit, "machine": f"{model}, {cores} cores, {build}", "versions": versions}


def rows_file(text: str) -> Path:
    """The argument of a command that measures for hours and then writes its rows to this file."""
    path = Path(text)
    if path.is_dir():
        raise ArgumentTypeError(
            f"{text} is a folder. Name a file for the rows, such as {path / 'rows.jsonl'}."
        )
    return path


def footer(rows: list[Row]) -> str:
    """The line under a figure or table: the machines, versions and commits of its rows."""

    def distinct(texts: Iterable[str], between: str) -> str:
        return between.join(dict.fromkeys(texts))

    machines = distinct((row["machine"] for row in rows), "; ")
    versions = distinct((", ".join(f"{k} {v}" for k, v in row["versions"].items()) for row in rows), "; ")
    commits = distinct((row["commit"] for row in rows), ", ")
    return f"{machines} · {versions} · commit {commits}"


def worked() -> float:
    """CPU seconds of all programs on the machine since boot. The share of other programs is stored with each row."""
    import psutil

    times = psutil.cpu_times()
    return float(sum(times) - times.idle - getattr(times, "iowait", 0.0) - getattr(times, "guest", 0.0))


def replace(path: Path, rows: Iterable[Row]) -> None:
    """Replace a file by `rows`. An interrupted write leaves the file as it was."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    part.write_text("".join(json.dumps(row) + "\n" for row in rows))
    part.replace(path)


def append(path: Path, row: Row) -> None:
    """Append a row and sync the file. An incomplete last line of an interrupted write is removed first."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("ab+") as stream:
        stream.seek(0)
        stream.truncate(stream.read().rfind(b"\n") + 1)
        stream.write(json.dumps(row).encode() + b"\n")
        stream.flush()
        os.fsync(stream.fileno())


def lines(path: Path) -> list[Row]:
    """The rows of a file; none where there is no file. An incomplete last line is ignored."""
    text = path.read_text() if path.is_file() else ""
    return [json.loads(line) for line in text[: text.rfind("\n") + 1].splitlines()]


def read(name: str) -> list[Row]:
    return lines(HERE / "results" / f"{name}.jsonl")


def of(rows: Iterable[Row], **fields: object) -> list[Row]:
    """The rows whose fields have the given values."""
    return [row for row in rows if all(row.get(name) == value for name, value in fields.items())]


def distinct(rows: Iterable[Row], name: str) -> list[Any]:
    """The values of a field, each once, in order."""
    return list(dict.fromkeys(row[name] for row in rows))


def build(name: str) -> AbstractContextManager[None]:
    """Run every CPU op in this block with one build of the kernels: avx512, avx2 or baseline."""
    from splatmill_worker.kernels.cpu import isa

    return running(isa.load(name))


@contextmanager
def running(engine: ModuleType) -> Iterator[None]:
    """Run every CPU op in this block with an extension module of the kernels."""
    from splatmill_worker.kernels.cpu import bin, composite, loss, project, step  # noqa: F401

    prefix = "splatmill_worker.kernels.cpu"
    modules = [m for k, m in sys.modules.items() if k.startswith(prefix) and hasattr(m, "engine")]
    before = [m.engine for m in modules]
    for m in modules:
        m.engine = engine  # type: ignore[attr-defined]  # modules have no declared attributes
    try:
        yield
    finally:
        for m, old in zip(modules, before, strict=True):
            m.engine = old  # type: ignore[attr-defined]  # modules have no declared attributes
