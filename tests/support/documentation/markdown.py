"""Fenced code blocks of Markdown pages, with the marks that say how a test runs them.

A mark is an HTML comment on the line before a block, which readers do not see:

    <!-- not run: REASON -->     the block cannot run in a test, and why
    <!-- exits: 5 -->            the block ends with this status instead of 0
    <!-- serves -->              the block starts a service, which later blocks of the page talk to
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from tests.support.paths import ROOT

FOLDERS = ("", "programming")
"""Folders below docs/ with pages that people write."""

GUIDES = sorted(page for folder in FOLDERS for page in (ROOT / "docs" / folder).glob("*.md"))

_FENCE = re.compile(r"^(?P<fence>`{3,})(?P<language>[^\n`]*)\n(?P<text>.*?)^(?P=fence)\s*$", re.M | re.S)
_MARK = re.compile(r"<!--\s*(?P<name>[a-z ]+?)(?::\s*(?P<value>[^>]*?))?\s*-->\s*\Z")


@dataclass(frozen=True)
class Block:
    """One fenced block: its page, the line of its fence (from 1), language, text, and its mark, if any."""

    page: Path
    line: int
    language: str
    text: str
    mark: str | None = None
    value: str = ""

    @property
    def place(self) -> str:
        """`page:line`, for messages."""
        return f"{self.page.name}:{self.line}"


def blocks(page: Path) -> list[Block]:
    """The fenced blocks of a page, in order."""
    text = page.read_text()
    return [_block(page, text, match) for match in _FENCE.finditer(text)]


def without_blocks(text: str) -> str:
    """The page's prose: its text without fenced blocks."""
    return _FENCE.sub("", text)


def _block(page: Path, text: str, match: re.Match[str]) -> Block:
    mark = _MARK.search(text[: match.start()])
    return Block(
        page,
        text.count("\n", 0, match.start()) + 1,
        match["language"].strip(),
        match["text"],
        mark["name"] if mark else None,
        (mark["value"] or "") if mark else "",
    )
