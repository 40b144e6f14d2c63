"""`splatmill up`, `doctor` and `bench`: programs of the other parts, started under one name."""

import os
import sys

import typer

from splatmill.cli.embedded import SUPERVISOR, require


def up(context: typer.Context) -> None:
    """Run the whole service on this machine; Ctrl-C ends it. Takes --host, --port, --data and more: up --help."""
    require("splatmill_server", "`splatmill up`")
    become(SUPERVISOR, *context.args)


def doctor(context: typer.Context) -> None:
    """Check what this machine has: backends, threads, memory, Redis, storage."""
    require("splatmill_worker", "`splatmill doctor`")
    become("splatmill_worker", "doctor", *context.args)


def bench(context: typer.Context) -> None:
    """Measure error against run time: kernels, stability, sfm, train. More: bench --help."""
    require("splatmill_worker", "`splatmill bench`")
    become("splatmill_worker", "bench", *context.args)


def become(module: str, *arguments: str) -> None:
    """Replace this process, so that signals and the exit code are those of the program itself."""
    sys.stdout.flush()
    sys.stderr.flush()
    os.execv(sys.executable, [sys.executable, "-m", module, *arguments])
