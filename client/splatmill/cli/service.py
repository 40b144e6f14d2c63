"""`splatmill up`, `doctor` and `bench`: programs of the server and the worker, run by the one command line."""

import os
import sys
from typing import NoReturn

import typer

from splatmill.cli.embedded import SUPERVISOR, require


def up(context: typer.Context) -> None:
    """Run the whole service on this machine until Ctrl-C. For its options: splatmill up --help."""
    require("splatmill_server", "`splatmill up`")
    exec_module(SUPERVISOR, *context.args)


def doctor(context: typer.Context) -> None:
    """Check this machine: backends, threads, memory, Redis, storage."""
    require("splatmill_worker", "`splatmill doctor`")
    exec_module("splatmill_worker", "doctor", *context.args)


def bench(context: typer.Context) -> None:
    """Measure errors and times: kernels, functions, stability, worst, stiffness, sfm, train, live, formats; and the
    service: soak, load, abuse, capacity, fleet, openapi, fuzz, and their summary."""
    require("splatmill_worker", "`splatmill bench`")
    exec_module("splatmill_worker", "bench", *context.args)


def exec_module(module: str, *arguments: str) -> NoReturn:
    """Replace this process by `python -m module`, so that signals and the exit code are those of that program."""
    sys.stdout.flush()
    sys.stderr.flush()
    os.execv(sys.executable, [sys.executable, "-m", module, *arguments])
