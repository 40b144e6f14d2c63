"""The number of unfinished uploads of a capture, which is bounded: each has a record, and may have bytes."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from weakref import WeakValueDictionary

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage
from splatmill_server.base.problems import ProblemError

MAX_UNFINISHED = 100
"""Uploads of one capture that may be unfinished at once. One that is left stays for a day."""

_REMEMBERED = 1000
"""Captures whose number one process remembers."""


class UnfinishedUploads:
    """Counts the unfinished uploads of captures."""

    def __init__(self, storage: Storage) -> None:
        self._storage = storage
        self._lock = threading.Lock()
        # One lock for each capture, so that no other capture waits while the uploads of one are listed.
        self._locks: WeakValueDictionary[str, threading.Lock] = WeakValueDictionary()
        # By capture: as last counted, with those begun since. To list a capture's uploads each time takes long.
        self._counts: dict[str, int] = {}
        self._beginning: set[tuple[str, str]] = set()

    @contextmanager
    def one_more(self, capture_id: str, upload_id: str) -> Iterator[None]:
        """Count an upload whose record is written in the context. Raises a 429 problem for too many."""
        with self._lock:
            lock = self._locks.setdefault(capture_id, threading.Lock())
        with lock:
            known = self._counts.get(capture_id, MAX_UNFINISHED)
            count = known if known < MAX_UNFINISHED else self._count(capture_id)
            with self._lock:
                if len(self._counts) >= _REMEMBERED:
                    self._counts.clear()
                self._counts[capture_id] = count + 1
                if count < MAX_UNFINISHED:
                    self._beginning.add((capture_id, upload_id))
        if count >= MAX_UNFINISHED:
            raise ProblemError(
                "too_many_requests",
                f"The capture has {MAX_UNFINISHED} uploads that are not complete.",
                advice="Complete some, or cancel them with DELETE /v1/captures/{id}/uploads/{upload}. One that "
                "receives no bytes for a day is deleted.",
                facts={"limit": MAX_UNFINISHED},
            )
        try:
            yield
        finally:
            with self._lock:
                self._beginning.discard((capture_id, upload_id))

    def _count(self, capture_id: str) -> int:
        with self._lock:
            ids = {upload for capture, upload in self._beginning if capture == capture_id}
        for entry in self._storage.entries(layout.capture_uploads(capture_id)):
            upload_id = entry.path.split("/")[3]
            if entry.path == layout.upload_record(capture_id, upload_id):
                ids.add(upload_id)
        return len(ids)
