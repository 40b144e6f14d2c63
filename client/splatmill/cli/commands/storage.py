"""`splatmill storage`: who holds what, the largest records, and what is deleted next."""

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Annotated

import typer

from splatmill.cli.servers import ServerOption, open_client

if TYPE_CHECKING:
    from splatmill.schema import StorageUse, StoredRecord

WIDTH = 200
"""Characters per line of what is not printed on a terminal."""


def storage(
    server: ServerOption = None,
    owner: Annotated[
        str | None, typer.Option("--owner", help="Show only this owner's records; for admins.")
    ] = None,
    largest: Annotated[
        int, typer.Option("-n", "--largest", min=0, max=1000, help="Number of the largest records to list.")
    ] = 10,
    as_json: Annotated[bool, typer.Option("--json", help="Print everything as one JSON object.")] = False,
) -> None:
    """Show who holds how much in storage, the largest records, and what is deleted next."""
    with open_client(server) as client:
        use = client.storage(owner=owner, largest=largest)
    if as_json:
        typer.echo(use.model_dump_json(indent=2))
        return
    from rich.console import Console

    console = Console()
    if not console.is_terminal:
        console = Console(width=WIDTH)  # for programs and files, which have no width of their own
    _print_owners(console, use)
    _print_largest(console, use)
    _print_deletions(console, use)


def _print_owners(console: object, use: "StorageUse") -> None:
    from splatmill.schema import format_bytes

    rows = []
    for owner_use in use.owners:
        kinds = owner_use.by_kind
        sizes = (owner_use.bytes, kinds.captures, kinds.sfm, kinds.jobs, kinds.models, kinds.uploads)
        limit = "none" if owner_use.limit is None else format_bytes(owner_use.limit)
        rows.append((owner_use.owner or "(nobody)", *(format_bytes(size) for size in sizes), limit))
    _print_table(
        console, ("owner", "total", "captures", "cameras", "jobs", "models", "uploads", "limit"), rows
    )


def _print_largest(console: object, use: "StorageUse") -> None:
    from splatmill.schema import format_bytes

    if not use.largest:
        typer.echo("\nNothing is stored yet.")
        return
    typer.echo("\nThe largest records:")
    now = datetime.now(UTC)
    rows = [
        (
            record.kind.value,
            record.id,
            record.name or "",
            record.owner or "(nobody)",
            format_bytes(record.bytes),
            _ago(record.last_used, now),
            _fate(record, now),
        )
        for record in use.largest
    ]
    _print_table(console, ("kind", "id", "name", "owner", "size", "last used", "deleted"), rows)


def _print_deletions(console: object, use: "StorageUse") -> None:
    from splatmill.schema import format_bytes

    if not use.deletions:
        typer.echo("\nThe next sweep deletes nothing.")
        return
    typer.echo(f"\nThe next sweep deletes {format_bytes(sum(record.bytes for record in use.deletions))}:")
    rows = [(record.kind, record.id, format_bytes(record.bytes), record.reason) for record in use.deletions]
    _print_table(console, ("kind", "id", "size", "reason"), rows)


def _print_table(console: object, heads: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> None:
    from rich.console import Console
    from rich.table import Table

    assert isinstance(console, Console)
    table = Table(box=None, pad_edge=False)
    for head in heads:
        table.add_column(head, overflow="fold")
    for row in rows:
        table.add_row(*row)
    console.print(table)


def _fate(record: "StoredRecord", now: datetime) -> str:
    """Return when a record is deleted by its age."""
    if record.needed_by is not None:
        return f"not before job {record.needed_by} ends"
    if record.expires_at is None:
        return "on request"
    left = (record.expires_at - now).total_seconds()
    return f"in {_span(left)}" if left > 0 else "by the next sweep"


def _ago(moment: datetime, now: datetime) -> str:
    return f"{_span(max((now - moment).total_seconds(), 0.0))} ago"


def _span(seconds: float) -> str:
    from splatmill.schema import format_duration

    return f"{seconds / 86400:.0f} d" if seconds >= 2 * 86400 else format_duration(seconds)
