"""Which records a list holds: filters by owner, labels, capture and state."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from splatmill.schema import DEFAULT_OWNER, JobState


@dataclass(frozen=True)
class Filter:
    """What the records of a list have in common. None stands for any.

    owner: the owner.
    name: a text that the name contains, in any case of letters.
    tag: one of the tags, in any case of letters.
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
        named = self.name is None or self.name.casefold() in (name or "").casefold()
        tagged = self.tag is None or self.tag.casefold() in [tag.casefold() for tag in tags]
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
