"""`splatmill storage`: who holds what, the largest records, and what is deleted next."""

from datetime import UTC, datetime
from typing import TYPE_CHECKING, Annotated

import typer

from splatmill.cli.display.tables import print_table
from splatmill.cli.servers import ServerOption, open_client

if TYPE_CHECKING:
    from splatmill.schema import StorageUse, StoredRecord


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
    _print_owners(use)
    _print_largest(use)
    _print_deletions(use)


def _print_owners(use: "StorageUse") -> None:
    from splatmill.schema import format_bytes

    rows = []
    for owner_use in use.owners:
        kinds = owner_use.by_kind
        sizes = (owner_use.bytes, kinds.captures, kinds.sfm, kinds.jobs, kinds.models, kinds.uploads)
        limit = "none" if owner_use.limit is None else format_bytes(owner_use.limit)
        rows.append((owner_use.owner or "(nobody)", *(format_bytes(size) for size in sizes), limit))
    print_table(("owner", "total", "captures", "cameras", "jobs", "models", "uploads", "limit"), rows)


def _print_largest(use: "StorageUse") -> None:
    from splatmill.schema import format_bytes

    if not use.largest:
        typer.echo("\nNothing is stored yet.")
        return
    typer.echo("\nThe largest records:")
    now = datetime.now(UTC)
    rows = [
        (
            record.id,
            record.name or "",
            record.kind.value,
            record.owner or "(nobody)",
            format_bytes(record.bytes),
            _ago(record.last_used, now),
            _fate(record, now),
        )
        for record in use.largest
    ]
    print_table(("id", "name", "kind", "owner", "size", "last used", "deleted"), rows)


def _print_deletions(use: "StorageUse") -> None:
    from splatmill.schema import format_bytes

    if not use.deletions:
        typer.echo("\nThe next sweep deletes nothing.")
        return
    typer.echo(f"\nThe next sweep deletes {format_bytes(sum(record.bytes for record in use.deletions))}:")
    rows = [(record.id, record.kind, format_bytes(record.bytes), record.reason) for record in use.deletions]
    print_table(("id", "kind", "size", "reason"), rows)


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
