"""Tables and lines of records on the terminal, and the same records as JSON."""

import shutil
import sys
from collections.abc import Callable, Iterable, Sequence
from datetime import datetime
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

if TYPE_CHECKING:
    from pydantic import BaseModel

Record = TypeVar("Record", bound="BaseModel")

JsonLines = Annotated[bool, typer.Option("--json", help="Print one JSON object per line and record.")]
"""The option of commands that list records."""

JsonRecord = Annotated[bool, typer.Option("--json", help="Print the record as JSON.")]
"""The option of commands that show one record."""

_GAP = "  "
_LEAST = 8  # columns that are left to the text that is shortened


def print_table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print rows of text under the names of their columns, one line for each row.

    The second column is shortened where lines would be longer than the terminal is wide.
    """
    from rich.cells import cell_len, set_cell_size

    cells = [[*columns], *([printable(cell) for cell in row] for row in rows)]
    widths = [max(cell_len(row[index]) for row in cells) for index in range(len(columns))]
    if sys.stdout.isatty():
        over = sum(widths) + len(_GAP) * (len(widths) - 1) - shutil.get_terminal_size().columns
        widths[1] = min(widths[1], max(widths[1] - over, _LEAST))
    for row in cells:
        if cell_len(row[1]) > widths[1]:
            row[1] = set_cell_size(row[1], widths[1] - 1) + "…"
        line = _GAP.join(set_cell_size(cell, width) for cell, width in zip(row, widths, strict=True))
        typer.echo(line.rstrip())


def print_list(
    records: Sequence[Record],
    as_json: bool,
    columns: Sequence[str],
    row: Callable[[Record], Sequence[str]],
    none: str,
) -> None:
    """Print records as JSON, or as a table with a row for each, or the sentence `none` where there are none."""
    if as_json:
        print_lines(records)
    elif records:
        print_table(columns, map(row, records))
    else:
        typer.echo(none)


def print_facts(facts: Iterable[tuple[str, str]]) -> None:
    """Print a line for each fact that is not empty: its name, and its value."""
    for name, value in facts:
        if value:
            typer.echo(f"{name:<10}{printable(value)}")


def print_lines(records: Iterable["BaseModel"]) -> None:
    """Print each record as a JSON object on a line of its own."""
    for record in records:
        typer.echo(record.model_dump_json(exclude_none=True))


def print_record(record: "BaseModel") -> None:
    """Print a record as an indented JSON object."""
    typer.echo(record.model_dump_json(indent=2, exclude_none=True))


def local_time(moment: datetime) -> str:
    """Return a time in the time zone of this machine, to the minute."""
    return moment.astimezone().strftime("%Y-%m-%d %H:%M")


def printable(text: str) -> str:
    """Return text without control characters, which could change what the terminal shows: names come from anyone."""
    return "".join(char if char.isprintable() else "\N{REPLACEMENT CHARACTER}" for char in text)
