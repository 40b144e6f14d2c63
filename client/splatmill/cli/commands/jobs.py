"""`splatmill jobs`, `status`, `cancel`, `restart`, `rename`, `label` and `options`."""

from typing import TYPE_CHECKING, Annotated

import typer

from splatmill.cli.commands.records import Favourite, Sort, Tag, label_facts
from splatmill.cli.display.tables import (
    JsonLines,
    JsonRecord,
    local_time,
    print_facts,
    print_lines,
    print_list,
    print_record,
    printable,
)
from splatmill.cli.servers import ServerOption, open_client
from splatmill.schema import JobState, ListOrder

if TYPE_CHECKING:
    from splatmill.schema import Job

JobId = Annotated[str, typer.Argument(metavar="JOB", help="Id of the job.", show_default=False)]


def jobs(
    state: Annotated[
        list[JobState] | None,
        typer.Option(
            "--state",
            metavar="STATE",
            help=f"List only jobs in this state: {', '.join(JobState)}. May be repeated.",
            show_default=False,
        ),
    ] = None,
    name: Annotated[
        str | None,
        typer.Option("--name", help="List only jobs whose name contains this text, in any case and accent."),
    ] = None,
    capture: Annotated[
        str | None, typer.Option("--capture", metavar="ID", help="List only jobs on this capture.")
    ] = None,
    tag: Tag = None,
    favourite: Favourite = None,
    sort: Sort = ListOrder.newest,
    owner: Annotated[
        str | None,
        typer.Option("--owner", help="List only this owner's jobs; it needs a key with the scope admin."),
    ] = None,
    limit: Annotated[int, typer.Option("-n", "--limit", min=1, help="Largest number of jobs to list.")] = 20,
    as_json: JsonLines = False,
    server: ServerOption = None,
) -> None:
    """List the jobs, newest first or as --sort says."""
    with open_client(server) as client:
        chosen = client.jobs(
            limit=limit,
            state=state,
            name=name,
            tag=tag,
            favourite=favourite,
            capture=capture,
            sort=sort,
            owner=owner,
        )
        listed = list(chosen)
    narrowed = state or name or tag or favourite is not None or capture or owner
    begin = "There are no jobs yet. Start one with: splatmill train PHOTOS --server URL"
    none = "No job matches." if narrowed else begin
    print_list(listed, as_json, ("job", "name", "state", "progress", "created"), _row, none)


def _row(job: "Job") -> tuple[str, ...]:
    """Return the row of a job in the list."""
    return job.id, job.name or "", job.state.value, _brief_progress(job), local_time(job.created_at)


def status(
    job_id: JobId,
    as_json: JsonRecord = False,
    server: ServerOption = None,
) -> None:
    """Show the state, progress, plan and problem of a job."""
    with open_client(server) as client:
        job = client.job(job_id).job
    if as_json:
        print_record(job)
        return
    from splatmill.cli.display.plan import plan_lines
    from splatmill.schema import format_duration

    duration = (
        (job.finished_at - job.started_at).total_seconds() if job.started_at and job.finished_at else None
    )
    facts = [
        ("job", job.id),
        ("name", job.name or ""),
        *label_facts(job),
        ("owner", job.owner),
        ("capture", job.capture),
        ("state", job.state.value + (" (cancel requested)" if _cancelling(job) else "")),
        ("queue", _queue(job)),
        ("attempt", str(job.attempt)),
        ("created", job.created_at.astimezone().strftime("%Y-%m-%d %H:%M:%S")),
        ("took", format_duration(duration) if duration is not None else ""),
        ("progress", _progress(job)),
        ("problem", job.problem.sentence if job.problem else ""),
    ]
    print_facts([*facts, *(("plan", line) for line in plan_lines(job.plan or {}))])


def _queue(job: "Job") -> str:
    """Return where a waiting job stands, or "" for another one."""
    if job.queue_position is None:
        return ""
    before = {0: "next", 1: "1 job before it"}.get(job.queue_position, f"{job.queue_position} jobs before it")
    if job.waiting_for is not None:
        return f"{before}; no worker serves the queue {job.waiting_for!r}"
    if job.estimated_start is not None:
        return f"{before}; starts about {job.estimated_start.astimezone().strftime('%Y-%m-%d %H:%M')}"
    return before


def cancel(job_id: JobId, server: ServerOption = None) -> None:
    """Cancel a job, and wait until it has ended."""
    with open_client(server) as client:
        handle = client.job(job_id)
        handle.cancel()
        for _ in handle.events():
            pass
        state = handle.refresh().state
    typer.echo(f"The job {job_id} is {state.value}.")


def restart(job_id: JobId, server: ServerOption = None) -> None:
    """Run a job that has ended again, from its last checkpoint if there is one."""
    with open_client(server) as client:
        job = client.job(job_id).restart()
    typer.echo(f"The job {job.id} is {job.state.value}. See how it gets on: splatmill follow {job.id}")


def rename(
    job_id: JobId,
    name: Annotated[str, typer.Argument(metavar="NAME", help='The new name; "" takes the name away.')],
    server: ServerOption = None,
) -> None:
    """Name a job, and its model with it."""
    with open_client(server) as client:
        job = client.job(job_id).rename(name or None)
    typer.echo(
        f"The job {job.id} is named {printable(job.name)}." if job.name else f"The job {job.id} has no name."
    )


def label(
    job_id: Annotated[
        str, typer.Argument(metavar="ID", help="Id of the job and of its model.", show_default=False)
    ],
    tags: Annotated[
        str | None,
        typer.Option(
            "--tags",
            metavar="TAGS",
            help='Its tags, in place of those that it has, as in "garden, drone"; "" takes them away.',
            show_default=False,
        ),
    ] = None,
    favourite: Annotated[
        bool | None,
        typer.Option(
            "--favourite/--no-favourite", help="Give it a star, or take it away.", show_default=False
        ),
    ] = None,
    server: ServerOption = None,
) -> None:
    """Give a job, and its model with it, tags and a star."""
    if tags is None and favourite is None:
        raise typer.BadParameter("Say what to change: give --tags, --favourite or --no-favourite.")
    words = None if tags is None else [tag.strip() for tag in tags.split(",") if tag.strip()]
    with open_client(server) as client:
        job = client.job(job_id).label(tags=words, favourite=favourite)
    said = f"tagged {printable(', '.join(job.tags))}" if job.tags else "without tags"
    typer.echo(f"The job {job.id} is {said}{', with a star' if job.favourite else ''}.")


def options(as_json: JsonLines = False) -> None:
    """List the training options with their defaults, ranges and help."""
    from rich.console import Console
    from rich.table import Table

    from splatmill.schema import describe_options

    if as_json:
        print_lines(describe_options())
        return
    table = Table("option", "default", "range", "help", box=None, pad_edge=False)
    for option in describe_options():
        default = "automatic" if option.default is None else str(option.default)
        table.add_row(option.flag, default, option.range_text.replace("|", " "), option.help)
    Console().print(table)


def _cancelling(job: "Job") -> bool:
    return job.cancel_requested and not job.state.final


def _brief_progress(job: "Job") -> str:
    """Return the stage of an unfinished job, and how much of it is done."""
    progress = job.progress
    if progress is None or job.state.final:
        return ""
    return f"{progress.stage} {progress.done / progress.total:.0%}" if progress.total else progress.stage


def _progress(job: "Job") -> str:
    from splatmill.cli.display.progress import progress_text

    return progress_text(job.progress) if job.progress else ""
