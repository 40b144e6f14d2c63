"""Pages in Markdown: their prose is written in them, and what follows from rows stands between two comments each."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from _rows import Row

END = "<!-- end of it -->"

Column = tuple[str, str | Callable[[Row], object]]
"""The head of a column, and its cell: a format string over the fields of a row, or a function of the row."""


def filled(page: str, blocks: Mapping[str, str]) -> str:
    """The page with the text of every block between its comments. Raises ValueError where they are missing."""
    for name, text in blocks.items():
        begin = f"<!-- from rows: {name} -->\n"
        before, opening, rest = page.partition(begin)
        _, closed, after = rest.partition(END)
        if not (opening and closed):
            raise ValueError(f"The page has no place for {name!r}: {begin.strip()} and {END} are not in it.")
        page = f"{before}{begin}{text}\n{END}{after}"
    return page


def table(head: str, lines: Iterable[Iterable[object]]) -> str:
    """A Markdown table; `head` holds the column names, separated by bars. A colon behind a name aligns it right."""
    names = [name.removesuffix(":") for name in head.split("|")]
    rule = "".join("---:|" if name.endswith(":") else "---|" for name in head.split("|"))
    rows = [" | ".join(str(cell).replace("|", "/").replace("\n", " ") for cell in cells) for cells in lines]
    return "\n".join(["| " + " | ".join(names) + " |", "|" + rule, *(f"| {row} |" for row in rows)])


def of_rows(columns: Sequence[Column], rows: Iterable[Row]) -> str:
    """The table with a line for each row."""
    cells = [
        [cell.format_map(row) if isinstance(cell, str) else cell(row) for _, cell in columns] for row in rows
    ]
    return table("|".join(head for head, _ in columns), cells)


def section(title: str, text: str) -> list[str]:
    """A heading and its text, or nothing where the text is empty."""
    return [f"## {title}", text] if text else []


def beside(path: Path, page: Path) -> str:
    """The relative link from `page` to `path`."""
    return Path(os.path.relpath(path.resolve(), page.resolve().parent)).as_posix()
