"""`splatmill delete`: jobs with their models, and captures."""

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

import typer

from splatmill.cli.display.tables import printable
from splatmill.cli.servers import ServerOption, open_client

if TYPE_CHECKING:
    from splatmill.schema import Capture
    from splatmill.sdk.client import Client, JobHandle


def delete(
    ids: Annotated[
        list[str],
        typer.Argument(metavar="ID", help="Ids of jobs, models or captures.", show_default=False),
    ],
    yes: Annotated[bool, typer.Option("-y", "--yes", help="Do not ask.")] = False,
    server: ServerOption = None,
) -> None:
    """Delete jobs with their models, or captures with their photos.

    A model has the id of its job, and both are deleted together. The capture of a job is kept.
    """
    with open_client(server) as client:
        # All are looked up before the first is deleted, so that a wrong id deletes nothing.
        records = [_find(client, record_id) for record_id in dict.fromkeys(ids)]
        if not yes:
            _ask([description for description, _ in records])
        for description, remove in records:
            remove()
            typer.echo(f"Deleted {description}.")


def _ask(descriptions: list[str]) -> None:
    if not sys.stdin.isatty():
        raise typer.BadParameter("There is no terminal to ask on; give --yes to delete.", param_hint="--yes")
    for description in descriptions:
        typer.echo(f"  {description}")
    if not typer.confirm("Delete this for good?" if len(descriptions) == 1 else "Delete these for good?"):
        typer.echo("Nothing was deleted.")
        raise typer.Exit(1)


def _find(client: "Client", record_id: str) -> tuple[str, Callable[[], None]]:
    """Return what a record is, as text, and the function that deletes it. Raises NotFound and Conflict."""
    from splatmill.errors import NotFound
    from splatmill.schema import Problem

    try:
        job = client.job(record_id)
        return _describe_job(client, job), job.delete
    except NotFound as error:
        if error.code != "job_not_found":
            raise
    try:
        capture = client.capture(record_id)
        return _describe_capture(capture), lambda: client.delete_capture(capture.id)
    except NotFound as error:
        raise NotFound(
            Problem.of(
                "not_found",
                f"There is no job, model or capture {record_id[:80]!r}.",
                advice="`splatmill jobs`, `splatmill models` and `splatmill captures` list what there is.",
            )
        ) from error


def _describe_job(client: "Client", handle: "JobHandle") -> str:
    from splatmill.errors import Conflict
    from splatmill.schema import Problem, format_bytes

    job = handle.job
    if not job.state.final:
        raise Conflict(
            Problem.of(
                "job_running",
                f"The job {job.id} has not ended; its state is {job.state.value}.",
                advice=f"Cancel it first: splatmill cancel {job.id}",
            )
        )
    text = f"the job {job.id} ({_named(job.name)}{job.state.value})"
    if job.model is not None:
        record = client.model(job.model).model
        text += f" and its model of {record.gaussians:,} Gaussians, {format_bytes(record.bytes)}"
    return text


def _describe_capture(capture: "Capture") -> str:
    from splatmill.schema import format_bytes

    size = format_bytes(sum(file.size for file in capture.files))
    return f"the capture {capture.id} ({_named(capture.name)}{len(capture.files)} files, {size})"


def _named(name: str | None) -> str:
    return f"{printable(name)}, " if name else ""
