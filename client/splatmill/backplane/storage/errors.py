"""The errors of storage, each a sentence with the path and the cause.

StorageError                storage cannot be read or written
    StorageFullError        full: disk, quota or file size limit
    StorageStalledError     no answer, or no further byte, within the patience of `bucket`
    StorageUnreachableError no connection, a connection that broke, or answers 429, 500 to 504
    StorageBusyError        too many operations wait for storage already
    StorageChangedError     a file was replaced while it was read
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager

from obstore.exceptions import BaseError, PreconditionError

_FULL = ("os error 28", "os error 122", "os error 27", "No space left", "QuotaExceeded", "StorageFull")

# What obstore shows of its causes: the kind of a failed request, and the status of an answer.
_STALLED = re.compile(r"kind: Timeout|TimedOut|operation timed out")
_UNREACHABLE = re.compile(
    r"kind: (Connect|Request|Interrupted|Decode)\b|IncompleteMessage|connection closed"
    r"|status: (429|50[0-4])\b|status code: (429|50[0-4])\b"
)


class StorageError(Exception):
    """Storage cannot be read or written. The message says what was tried, and the reason.

    kind: what happened, in a word.
    summary: what happened, in a sentence without names of files, addresses and buckets. Anybody may read it.
    """

    kind = "failed"
    summary = "Storage cannot be read or written."


class StorageFullError(StorageError):
    """Storage is full (disk, quota or file size limit). Nothing was stored."""

    kind = "full"
    summary = "Storage is full."


class StorageStalledError(StorageError):
    """Storage has not answered, or has sent no further byte, for too long, also when it was asked again."""

    kind = "stalled"
    summary = "Storage does not answer in time."


class StorageUnreachableError(StorageError):
    """Storage cannot be reached, breaks connections, or answers that it cannot serve, also when it was asked again."""

    kind = "unreachable"
    summary = "Storage cannot be reached."


class StorageBusyError(StorageError):
    """As many operations as may wait for storage wait already; this one was not begun."""

    kind = "busy"
    summary = "Storage does not answer, and as many operations as may wait for it wait already."


class StorageChangedError(StorageError):
    """A file was replaced while it was read, so that the rest of the bytes would be of another file."""

    kind = "changed"
    summary = "A file was replaced while it was read."


@contextmanager
def storage_errors(verb: str, path: str) -> Iterator[None]:
    """Convert errors of obstore, which contain Rust debug output, into a StorageError with one sentence."""
    try:
        yield
    except FileNotFoundError:
        raise
    except (BaseError, OSError) as error:
        raise _named(verb, path, error) from error


def _named(verb: str, path: str, error: Exception) -> StorageError:
    text = str(error)
    fact = text.split("\n\nDebug source")[0].strip().removesuffix(":")
    if any(sign in text for sign in _FULL):
        return StorageFullError(f"Storage is full: it could not {verb} {path} ({fact}).")
    if isinstance(error, PreconditionError):
        return StorageChangedError(f"Storage could not {verb} {path}: it was replaced meanwhile. Try again.")
    if _STALLED.search(text):
        return StorageStalledError(f"Storage does not answer: it could not {verb} {path} in time ({fact}).")
    if _UNREACHABLE.search(text):
        return StorageUnreachableError(f"Storage could not {verb} {path}: {fact}.")
    return StorageError(f"Storage could not {verb} {path}: {fact}.")
