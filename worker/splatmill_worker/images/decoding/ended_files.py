"""The files that ended their decoding process twice, which the attempts at a job do not open again."""

from __future__ import annotations

import json
import threading
from contextlib import suppress
from pathlib import Path

from pydantic import TypeAdapter

from splatmill.files import atomic_write

_REASONS: TypeAdapter[dict[str, str]] = TypeAdapter(dict[str, str])


class EndedFiles:
    """Why files are not opened again, by their path below the job's folder.

    kept: the file that keeps this for the next attempt; None: it is not kept. A damaged file counts as empty, and so
        costs two processes for each of the files that it named.
    """

    def __init__(self, kept: Path | None) -> None:
        self._kept = kept
        self._lock = threading.Lock()
        self._reasons: dict[str, str] = {}
        if kept is not None:
            with suppress(OSError, ValueError):
                self._reasons = _REASONS.validate_json(kept.read_bytes())

    def reason(self, key: str) -> str | None:
        return self._reasons.get(key)

    def add(self, key: str, reason: str) -> None:
        with self._lock:
            self._reasons[key] = reason
            self._write()

    def forget(self) -> bool:
        with self._lock:
            had = bool(self._reasons)
            self._reasons = {}
            if had:
                self._write()
            return had

    def _write(self) -> None:
        # Written also when it is empty: a copy of it in storage is then replaced, too (`service.attempts.mirror`).
        if self._kept is not None:
            atomic_write(self._kept, json.dumps(self._reasons))
