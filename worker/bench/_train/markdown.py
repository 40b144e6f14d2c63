"""Tables and sections as Markdown."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path


def table(head: str, lines: Iterable[Iterable[object]]) -> str:
    """A Markdown table; `head` holds the column names, separated by bars."""
    names = head.split("|")
    rows = [" | ".join(str(cell).replace("|", "/").replace("\n", " ") for cell in cells) for cells in lines]
    return "\n".join(
        ["| " + " | ".join(names) + " |", "|" + "---|" * len(names), *(f"| {row} |" for row in rows)]
    )


def section(title: str, text: str) -> list[str]:
    """A heading and its text, or nothing where the text is empty."""
    return [f"## {title}", text] if text else []


def beside(path: Path, page: Path) -> str:
    """The relative link from `page` to `path`."""
    return Path(os.path.relpath(path.resolve(), page.resolve().parent)).as_posix()
