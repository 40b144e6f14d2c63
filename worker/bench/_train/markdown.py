"""Tables and sections as Markdown."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path


def table(head: str, lines: Iterable[Iterable[object]]) -> str:
    """A Markdown table; `head` names the columns, between bars."""
    names = head.split("|")
    rows = [" | ".join(str(cell).replace("|", "/").replace("\n", " ") for cell in cells) for cells in lines]
    return "\n".join(
        ["| " + " | ".join(names) + " |", "|" + "---|" * len(names), *(f"| {row} |" for row in rows)]
    )


def section(title: str, text: str) -> list[str]:
    """A heading and its text; nothing where there is no text."""
    return [f"## {title}", text] if text else []


def beside(path: Path, page: Path) -> str:
    """How `page` links to `path`."""
    return Path(os.path.relpath(path.resolve(), page.resolve().parent)).as_posix()
