"""Which records a list holds: filters by owner, labels, capture and state."""

import json
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from splatmill.schema import DEFAULT_OWNER, JobState

_ALIKE = str.maketrans(
    dict.fromkeys("\u2018\u2019\u201a\u201b\u2032\u00b4\u0060\u02bc", "'")
    | dict.fromkeys("\u201c\u201d\u201e\u201f\u00ab\u00bb\u2033", '"')
    | dict.fromkeys("\u2010\u2011\u2012\u2013\u2014\u2015\u2212", "-")
)
"""Quotes, apostrophes and dashes as keyboards have them: programs put others in their place while a name is typed."""


@dataclass(frozen=True)
class Filter:
    """What the records of a list have in common. None stands for any.

    owner: the owner.
    name: a text that the name contains, in any case and accent, with any form of quotes and dashes.
    tag: one of the tags, in any case and accent, with any form of quotes and dashes.
    favourite: whether it has a star.
    """

    owner: str | None = None
    name: str | None = None
    tag: str | None = None
    favourite: bool | None = None

    @property
    def by_labels(self) -> bool:
        """Whether the labels decide, and not the owner alone."""
        return any(label is not None for label in (self.name, self.tag, self.favourite))

    def admits(self, owner: str, name: str | None, tags: Sequence[str] = (), favourite: bool = False) -> bool:
        """Return whether a record with this owner and these labels is listed."""
        named = self.name is None or _plain(self.name) in _plain(name or "")
        tagged = self.tag is None or _plain(self.tag) in [_plain(tag) for tag in tags]
        starred = self.favourite in (None, favourite)
        return named and tagged and starred and self.owner in (None, owner)


@dataclass(frozen=True)
class JobFilter(Filter):
    """What the jobs of a list have in common.

    capture: the id of their capture.
    states: the states that they may be in.
    """

    FIELDS = ("id", "owner", "name", "capture", "tags", "favourite")
    """The fields of a job's row that `admits_row` needs."""

    capture: str | None = None
    states: frozenset[JobState] | None = None

    def admits_row(self, row: Mapping[str, bytes | None]) -> bool:
        """Return whether a job with these fields of its row may be listed; its state decides then."""
        if row["id"] is None or not (self.capture is None or _text(row["capture"]) == self.capture):
            return False
        tags = json.loads(row["tags"] or b"[]")
        starred = _text(row["favourite"]) == str(True)
        return self.admits(_text(row["owner"]) or DEFAULT_OWNER, _text(row["name"]), tags, starred)


def _text(value: bytes | None) -> str | None:
    return value.decode("utf-8", "replace") if value is not None else None


def _plain(text: str) -> str:
    """A text without what people leave out when they search: case, accents, the form of quotes and dashes."""
    # Before the decomposition too, which makes a space and an accent of an apostrophe such as U+00B4.
    letters = unicodedata.normalize("NFKD", text.translate(_ALIKE))
    return "".join(letter for letter in letters if not unicodedata.combining(letter)).casefold()
