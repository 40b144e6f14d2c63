"""`splatmill up`, `doctor` and `bench`: programs of the server and the worker, run by the one command line."""

import typer

from splatmill.cli.local.embedded import SUPERVISOR
from splatmill.cli.local.programs import exec_module, require


def up(context: typer.Context) -> None:
    """Run the whole service on this machine until Ctrl-C. For its options: splatmill up --help."""
    require("splatmill_server", "`splatmill up`")
    exec_module(SUPERVISOR, *context.args)


def doctor(context: typer.Context) -> None:
    """Check this machine: backends, threads, memory, Redis, storage."""
    require("splatmill_worker", "`splatmill doctor`")
    exec_module("splatmill_worker", "doctor", *context.args)


def bench(context: typer.Context) -> None:
    """Measure errors and times: kernels, scale, functions, stability, worst, stiffness, sfm, train, live, formats,
    mesh, gabor, ground; the service: soak, load, abuse, capacity, fleet, openapi, fuzz, their summary, and rq_alone."""
    require("splatmill_worker", "`splatmill bench`")
    exec_module("splatmill_worker", "bench", *context.args)
