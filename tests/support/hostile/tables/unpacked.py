"""Hostile archives whose files are harmless each and too much together."""

from __future__ import annotations

from collections.abc import Callable

from tests.support.hostile import archives
from tests.support.hostile.entry import Hostile


def _zip(what: str, made: Callable[[], bytes], said: str) -> Hostile:
    return Hostile("Archives", what, lambda bench: bench.prepared("images/set.zip", made()), "left out", said)


UNPACKED = (
    _zip("193 files of a MiB of zeros in 225 kB", archives.many_small, "to 1 as a whole"),
    _zip("200 files in 22,000 folders", archives.many_folders, "more than 20000 folders"),
)
