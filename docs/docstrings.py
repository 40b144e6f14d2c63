"""Docstrings for autodoc, which reads reStructuredText; the project writes them in a few forms of Markdown.

- Inline code has single backticks; here it gets double ones.
- Arguments and fields are lines of the form `name: meaning`; here they become a list.
"""

import re
from typing import Any

CODE = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
NAME = r"[a-z_]\w*"
ENTRY = re.compile(rf"(?P<names>{NAME}(?:, {NAME})*): (?P<meaning>.+)")


def as_restructured_text(
    app: Any, what: str, name: str, documented: Any, options: Any, lines: list[str]
) -> None:
    """Rewrite the docstring `lines` in place; the signature is that of autodoc-process-docstring."""
    lines[:] = [CODE.sub(r"``\1``", line) for line in _with_lists(lines)]


def _with_lists(lines: list[str]) -> list[str]:
    """The lines with each paragraph that begins with an entry as a list of entries."""
    written: list[str] = []
    inside = False
    for line in lines:
        entry = ENTRY.fullmatch(line)
        begins_paragraph = not written or not written[-1].strip()
        if entry and (inside or begins_paragraph):
            inside = True
            written.append(f"* **{entry['names']}**: {entry['meaning']}")
        elif inside and line.strip():
            written.append(f"  {line.strip()}")
        else:
            inside = False
            written.append(line)
    return written
