"""Room on the worker's disk for unpacked files, which the service counts within the quota of a job's owner.

Without the service, as where a local folder is trained, nothing is counted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

Claim = Callable[[str, int, bool], None]
"""Called with the name of a folder, the bytes of the files in it, and whether it may refuse them by an error."""

_claim: Claim | None = None


@contextmanager
def claimed_by(claim: Claim) -> Iterator[None]:
    """Let `claim` count what this process unpacks while the context is open."""
    global _claim
    before, _claim = _claim, claim
    try:
        yield
    finally:
        _claim = before


def take(folder: str, size: int, *, may_refuse: bool = True) -> None:
    """Count the bytes of a folder. Raises what the service refuses them with."""
    if _claim is not None:
        _claim(folder, size, may_refuse)
