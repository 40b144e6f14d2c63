"""Every `(decisions: NAME)` in code and documents leads to an entry of worker/bench/decisions.md, and every entry is
linked from somewhere, stands in alphabetical order and says what was run, on what, and whether it was bracketed.

Does not prove the figures in the entries.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
DECISIONS = ROOT / "worker" / "bench" / "decisions.md"
SEARCHED = ["worker/splatmill_worker", "worker/bench", "client/splatmill", "server/splatmill_server", "docs"]
SUFFIXES = {".py", ".md", ".cpp", ".h", ".inc"}
LINES = ["Question", "Runs", "Scenes", "Outcome", "Bracketed"]
PLACEHOLDER = "NAME"  # of the sentences that explain the form of a link


def pages() -> Iterator[Path]:
    """Files that may link to an entry."""
    yield from ROOT.glob("*.md")
    for folder in SEARCHED:
        for path in sorted((ROOT / folder).rglob("*")):
            if path.suffix in SUFFIXES and path.is_file():
                yield path


def links() -> dict[str, list[str]]:
    """Names linked to, each with the files that link to it. The name may stand on the line after "(decisions:"."""
    sources: dict[str, list[str]] = {}
    for path in pages():
        for name in re.findall(r"\(decisions:[\s#/*]*([^)]*)\)?", path.read_text()):
            if name != PLACEHOLDER:
                sources.setdefault(name, []).append(str(path.relative_to(ROOT)))
    return sources


def entries() -> dict[str, str]:
    """The text of each entry by its heading, in the order of the page."""
    _, *sections = re.split(r"^## ", DECISIONS.read_text(), flags=re.M)
    heads = [section.split("\n", 1) for section in sections]
    assert len({head for head, _ in heads}) == len(heads), "two entries have the same name"
    return {head.strip(): text for head, text in heads}


def test_every_link_leads_to_an_entry() -> None:
    assert links()
    missing = {name: files for name, files in links().items() if name not in entries()}
    assert not missing


def test_every_entry_is_linked_from_somewhere() -> None:
    assert not set(entries()) - set(links())


def test_entries_stand_in_alphabetical_order() -> None:
    assert list(entries()) == sorted(entries(), key=str.casefold)


@pytest.mark.parametrize("name", entries())
def test_an_entry_says_what_was_run_and_whether_it_was_bracketed(name: str) -> None:
    said = re.findall(r"^- \*\*(\w+)\*\*: \S", entries()[name], re.M)
    assert said == LINES
