"""`splatmill bin`: puts jobs with their models and captures into the bin of a server, lists and restores them."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from splatmill.cli.display.tables import JsonLines, local_time, print_list, printable
from splatmill.cli.servers import ServerOption, open_client

if TYPE_CHECKING:
    from splatmill.schema import Binned

T = TypeVar("T")

bin_commands = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Delete so that it can be restored for a day.",
)

Ids = Annotated[
    list[str], typer.Argument(metavar="ID", help="Ids of jobs, models or captures.", show_default=False)
]


@bin_commands.command()
def put(ids: Ids, server: ServerOption = None) -> None:
    """Put jobs with their models, or captures, into the bin. They are deleted for good a day later."""
    with open_client(server) as client:
        for record_id in dict.fromkeys(ids):
            binned = _either(record_id, client.bin.put_job, client.bin.put_capture)
            name = f" ({printable(binned.name)})" if binned.name else ""
            typer.echo(
                f"The {binned.kind.value} {binned.id}{name} is in the bin until {local_time(binned.deleted_at)}."
            )


@bin_commands.command()
def restore(ids: Ids, server: ServerOption = None) -> None:
    """Restore jobs with their models, or captures, from the bin."""
    with open_client(server) as client:
        for record_id in dict.fromkeys(ids):
            _either(record_id, client.bin.restore_job, client.bin.restore_capture)
            typer.echo(f"Restored {record_id}.")


@bin_commands.command("list")
def list_bin(as_json: JsonLines = False, server: ServerOption = None) -> None:
    """List what is in the bin, the newest first."""
    with open_client(server) as client:
        entries = client.bin.list()
    print_list(entries, as_json, ("id", "kind", "name", "deleted for good"), _row, "The bin is empty.")


def _row(entry: "Binned") -> tuple[str, ...]:
    """Return the row of a record in the list."""
    return entry.id, entry.kind.value, entry.name or "", local_time(entry.deleted_at)


def _either(record_id: str, of_job: Callable[[str], T], of_capture: Callable[[str], T]) -> T:
    """Return what is done to a record, which is a job or a capture. Raises NotFound if it is neither."""
    from splatmill.errors import NotFound

    try:
        return of_job(record_id)
    except NotFound as error:
        if error.code not in ("job_not_found", "not_in_bin"):
            raise
    return of_capture(record_id)
