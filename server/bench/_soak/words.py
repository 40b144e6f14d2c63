"""What a soak did, in words, from its rows: for its page and for the README."""

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

Row = Mapping[str, Any]


def jobs(end: Row) -> str:
    """Return how many jobs there were of each kind, from the row of the whole."""
    return ", ".join(f"{count} with {does}" for does, count in end["kinds"].items())


def kills(rows: Iterable[Row]) -> str:
    """Return how often a process of each role was killed, most often first."""
    count = Counter(row["fault"].removesuffix(" killed") for row in rows if row.get("kills"))
    return ", ".join(f"{role} {times}" for role, times in count.most_common())
