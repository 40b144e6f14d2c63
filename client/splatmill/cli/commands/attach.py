"""`splatmill follow` and `logs`: what a job on a server says, while it runs or afterwards."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from splatmill.cli.commands.jobs import JobId
from splatmill.cli.display.tables import printable
from splatmill.cli.servers import ServerOption, open_client

if TYPE_CHECKING:
    from splatmill.schema import EventRecord, LogLine
    from splatmill.sdk.client import JobHandle


def follow(
    job_id: JobId,
    out: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--out",
            metavar="DIR",
            help="When the job has succeeded, download its files to this folder.",
            show_default=False,
        ),
    ] = None,
    verbose: Annotated[
        bool, typer.Option("-v", "--verbose", help="Show the plan and all log lines.")
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print each event as a JSON object on a line of its own.")
    ] = False,
    server: ServerOption = None,
) -> None:
    """Show the progress of a job until it ends, from its beginning. Ctrl-C ends this command and not the job."""
    from splatmill.cli.commands.models.models import download_files, print_summary
    from splatmill.cli.exits import Exit
    from splatmill.errors import JobCancelled

    with open_client(server) as client:
        job = client.job(job_id)
        try:
            if as_json:
                for record in job.events():
                    typer.echo(record.model_dump_json(exclude_none=True))
            else:
                _show(job.events(), verbose)
        except KeyboardInterrupt:
            typer.echo(f"The job continues. See how it gets on: splatmill follow {job.id}", err=True)
            raise typer.Exit(Exit.cancelled) from None
        try:
            model = job.result()
        except JobCancelled as cancelled:
            typer.echo(cancelled.message, err=as_json)
            raise typer.Exit(Exit.cancelled) from None
        written = download_files(model, out) if out is not None else []
    if not as_json:
        print_summary(model, written)


def _show(events: Iterable["EventRecord"], verbose: bool) -> None:
    from splatmill.cli.display.progress import make_display, show

    with make_display() as display:
        for record in events:
            show(record, display, verbose=verbose)


def logs(
    job_id: JobId,
    follow: Annotated[
        bool, typer.Option("-f", "--follow", help="Wait for further lines until the job ends.")
    ] = False,
    limit: Annotated[
        int,
        typer.Option(
            "-n", "--limit", min=1, max=10_000, help="Largest number of lines; the last ones are shown."
        ),
    ] = 1000,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object per line of the log.")
    ] = False,
    server: ServerOption = None,
) -> None:
    """Show the log of a job, oldest line first."""
    with open_client(server) as client:
        job = client.job(job_id)
        lines: Iterable[LogLine] = _followed(job, limit) if follow else job.logs(limit=limit)
        for line in lines:
            if as_json:
                typer.echo(line.model_dump_json(exclude_none=True))
            else:
                moment = line.at.astimezone().strftime("%Y-%m-%d %H:%M:%S")
                typer.echo(f"{moment}  {line.level:<7}  {printable(line.message)}")


def _followed(job: "JobHandle", limit: int) -> Iterator["LogLine"]:
    """Yield the last `limit` lines that there are, then those that come after them, until the job ends."""
    from splatmill.schema import LogEvent, LogLine

    known = job.logs()
    yield from known[-limit:]
    for record in job.events():
        if isinstance(record.event, LogEvent):
            line = LogLine(attempt=record.attempt, at=record.at, **record.event.model_dump())
            # Events begin with the job, and several lines may have the same time.
            if not known or line.at > known[-1].at or (line.at == known[-1].at and line not in known):
                yield line
