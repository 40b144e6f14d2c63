"""Markdown that several generated pages are made of."""

from collections.abc import Iterable, Sequence


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table; line breaks and bars inside cells are made harmless."""
    lines = [_row(heads), _row(["---"] * len(heads)), *(_row([_cell(text) for text in row]) for row in rows)]
    return "\n".join(lines) + "\n"


def code(text: object) -> str:
    """`text` as inline code, or nothing for nothing."""
    return f"`{text}`" if f"{text}" else ""


def choices(values: Iterable[str]) -> str:
    """Values to choose from, each as inline code."""
    return ", ".join(code(value) for value in values)


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
