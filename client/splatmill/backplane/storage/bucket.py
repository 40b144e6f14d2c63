"""S3 buckets: how long a request may make no progress, how often it is repeated, and readings that go on after a break.

No limit counts a whole body. A download of any size may last as long as its bytes keep coming and its reader keeps
reading; an upload is sent in blocks, and the time of each is limited alone.
"""

import os
from dataclasses import dataclass
from datetime import timedelta
from typing import TYPE_CHECKING

from obstore.store import ObjectStore, from_url

from splatmill.backplane.storage.errors import StorageError, StorageStalledError, StorageUnreachableError

if TYPE_CHECKING:  # These names exist in its stubs alone.
    import obstore
    from obstore.store import ClientConfig, RetryConfig

BLOCK = 8 << 20
"""Bytes of a block of an upload. Larger files are uploaded in blocks, several at a time."""

_NO_LIMIT = "7days"
_FIRST_PAUSE = 0.1


@dataclass(frozen=True)
class Patience:
    """How long S3 may take.

    connect: seconds to open a connection.
    answer: seconds without a byte of the answer to a small request.
    block: seconds for a block of an upload, and without a further byte of a download.
    retries: how often a request is repeated after no answer, a broken connection, or an answer 429 or 500 to 504.
    slot: seconds that an operation waits for one of the threads that may wait for S3.
    """

    connect: float = 5.0
    answer: float = 10.0
    block: float = 60.0
    retries: int = 3
    slot: float = 1.0


def open_bucket(url: str, patience: Patience) -> tuple[ObjectStore, ObjectStore]:
    """Return two views of a bucket: for small requests, and for the bytes of files, which are waited for longer."""
    small, large = (
        from_url(
            url, client_options=_client(patience, seconds), retry_config=_retries(patience.retries, seconds)
        )
        for seconds in (patience.answer, patience.block)
    )
    return small, large


def _client(patience: Patience, seconds: float) -> "ClientConfig":
    # `timeout` is the limit of a whole body, 30 s unless it is set.
    endpoint = os.environ.get("AWS_ENDPOINT_URL") or os.environ.get("AWS_ENDPOINT") or ""
    return {
        "connect_timeout": timedelta(seconds=patience.connect),
        "read_timeout": timedelta(seconds=seconds),
        "timeout": _NO_LIMIT,
        "allow_http": endpoint.startswith("http://"),
    }


def _retries(count: int, seconds: float) -> "RetryConfig":
    # No request is repeated once this much time has passed, so that a stall is reported after two periods.
    return {
        "max_retries": count,
        "retry_timeout": timedelta(seconds=1.5 * seconds),
        "backoff": {
            "init_backoff": timedelta(seconds=_FIRST_PAUSE),
            "max_backoff": timedelta(seconds=2),
            "base": 2,
        },
    }


class Resumption:
    """Where a reading of the bytes [start, end) stands, so that it can go on after a break.

    obstore repeats a reading itself, but only until a fixed time after its first request, which a long download or a
    slow reader exceeds. Here every byte that comes makes the count of repetitions begin anew.

    version: of the file to read, as storage names it; None for the one that the first request returns.
    """

    def __init__(self, start: int, end: int | None, retries: int, version: str | None = None) -> None:
        self.position = start
        self._end = end
        self._etag = version
        self._retries = retries
        self._failures = 0

    def options(self) -> "obstore.GetOptions":
        """Return what the next request asks for: the bytes that are missing, of the same version of the file."""
        options: obstore.GetOptions = {}
        if self._end is not None:
            options["range"] = (self.position, self._end)
        elif self.position:
            options["range"] = {"offset": self.position}
        if self._etag is not None:
            options["if_match"] = self._etag
        return options

    def begun(self, meta: "obstore.ObjectMeta") -> None:
        """Note which version of the file is read."""
        self._etag = meta["e_tag"]
        self._end = meta["size"] if self._end is None else min(self._end, meta["size"])

    def received(self, count: int) -> None:
        """Note that `count` bytes more have come."""
        self.position += count
        self._failures = 0

    def pause(self, error: StorageError) -> float | None:
        """Return the seconds before the next request, or None if all bytes have come. Raises `error` if it is of no use
        to repeat."""
        if self._end is not None and self._etag is not None and self.position >= self._end:
            return None
        self._failures += 1
        if (
            not isinstance(error, StorageStalledError | StorageUnreachableError)
            or self._failures > self._retries
        ):
            raise error
        return _FIRST_PAUSE * 2.0**self._failures
