"""Which records a list holds: filters by owner, name, capture and state."""

from collections.abc import Mapping
from dataclasses import dataclass

from splatmill.schema import DEFAULT_OWNER, JobState


@dataclass(frozen=True)
class Filter:
    """What the records of a list have in common. None stands for any.

    owner: the owner.
    name: a text that the name contains, in any case of letters.
    """

    owner: str | None = None
    name: str | None = None

    def admits(self, owner: str, name: str | None) -> bool:
        """Return whether a record with this owner and name is listed."""
        named = self.name is None or self.name.casefold() in (name or "").casefold()
        return named and self.owner in (None, owner)


@dataclass(frozen=True)
class JobFilter(Filter):
    """What the jobs of a list have in common.

    capture: the id of their capture.
    states: the states that they may be in.
    """

    FIELDS = ("id", "owner", "name", "capture")
    """The fields of a job's row that `admits_row` needs."""

    capture: str | None = None
    states: frozenset[JobState] | None = None

    def admits_row(self, row: Mapping[str, bytes | None]) -> bool:
        """Return whether a job with these fields of its row may be listed; its state decides then."""
        if row["id"] is None or not (self.capture is None or _text(row["capture"]) == self.capture):
            return False
        return self.admits(_text(row["owner"]) or DEFAULT_OWNER, _text(row["name"]))


def _text(value: bytes | None) -> str | None:
    return value.decode("utf-8", "replace") if value is not None else None
