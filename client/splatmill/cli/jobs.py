"""`splatmill jobs`, `status`, `cancel` and `options`."""

from typing import TYPE_CHECKING, Annotated

import typer

from splatmill.cli.servers import ServerOption, open_client

if TYPE_CHECKING:
    from splatmill.schema import Job

JobId = Annotated[str, typer.Argument(metavar="JOB", help="Id of the job.", show_default=False)]


def jobs(
    server: ServerOption = None,
    limit: Annotated[int, typer.Option("-n", "--limit", min=1, help="Largest number of jobs to list.")] = 20,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object per line and job.")] = False,
) -> None:
    """List the jobs, newest first."""
    with open_client(server) as client:
        found = list(client.jobs(limit=limit))
    if as_json:
        for job in found:
            typer.echo(job.model_dump_json(exclude_none=True))
        return
    if not found:
        typer.echo("There are no jobs yet. Start one with: splatmill train PHOTOS --server URL")
        return
    from rich.console import Console
    from rich.table import Table

    table = Table("job", "name", "state", "progress", "created", box=None, pad_edge=False)
    for job in found:
        created = job.created_at.astimezone().strftime("%Y-%m-%d %H:%M")
        table.add_row(job.id, job.name or "", job.state.value, _progress(job), created)
    Console().print(table)


def status(
    job_id: JobId,
    server: ServerOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the record of the job as JSON.")] = False,
) -> None:
    """Show the state, progress, plan and problem of a job."""
    with open_client(server) as client:
        job = client.job(job_id).job
    if as_json:
        typer.echo(job.model_dump_json(indent=2, exclude_none=True))
        return
    from splatmill.cli.plan import plan_lines

    typer.echo(f"job       {job.id}" + (f" ({job.name})" if job.name else ""))
    typer.echo(f"state     {job.state.value}" + (" (cancel requested)" if _cancelling(job) else ""))
    typer.echo(f"attempt   {job.attempt}")
    typer.echo(f"created   {job.created_at.astimezone():%Y-%m-%d %H:%M:%S}")
    if job.started_at and job.finished_at:
        from splatmill.schema import format_duration

        typer.echo(f"took      {format_duration((job.finished_at - job.started_at).total_seconds())}")
    if job.progress:
        typer.echo(f"progress  {_progress(job)}")
    if job.problem:
        typer.echo(f"problem   {job.problem.sentence}")
    for line in plan_lines(job.plan or {}):
        typer.echo(f"plan      {line}")


def cancel(job_id: JobId, server: ServerOption = None) -> None:
    """Cancel a job, and wait until it has ended."""
    with open_client(server) as client:
        handle = client.job(job_id)
        handle.cancel()
        for _ in handle.events():
            pass
        state = handle.refresh().state
    typer.echo(f"The job {job_id} is {state.value}.")


def options() -> None:
    """List the training options with their defaults, ranges and help."""
    from rich.console import Console
    from rich.table import Table

    from splatmill.schema import describe_options

    table = Table("option", "default", "range", "help", box=None, pad_edge=False)
    for option in describe_options():
        default = "automatic" if option.default is None else str(option.default)
        table.add_row(option.flag, default, option.range_text.replace("|", " "), option.help)
    Console().print(table)


def _cancelling(job: "Job") -> bool:
    return job.cancel_requested and not job.state.final


def _progress(job: "Job") -> str:
    from splatmill.cli.progress import progress_text

    return progress_text(job.progress) if job.progress else ""
