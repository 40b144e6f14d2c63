"""Wall time of the stages of a job, over all attempts."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil

from splatmill.files import atomic_write

log = logging.getLogger("splatmill_worker")


class Stages:
    """Wall seconds by stage name, kept in a file, so that a later attempt adds to those of earlier ones."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.seconds: dict[str, float] = {}
        if path.is_file():
            try:
                self.seconds = {
                    str(stage): float(seconds) for stage, seconds in json.loads(path.read_text()).items()
                }
            except (ValueError, TypeError, AttributeError) as error:
                log.warning("The times of earlier attempts are not readable and count as 0: %s", error)

        self._earlier = sum(self.seconds.values())

    @property
    def elapsed(self) -> float:
        """Seconds since this process began, and those of the stages of earlier attempts."""
        return self._earlier + time.time() - float(psutil.Process().create_time())

    @contextmanager
    def measured(self, stage: str) -> Iterator[None]:
        """Add the time inside to `stage`, also where it ends with an exception."""
        started = time.perf_counter()
        try:
            yield
        finally:
            self.add(stage, time.perf_counter() - started)

    def add(self, stage: str, seconds: float) -> None:
        """Add `seconds` to `stage` and store the sums."""
        self.seconds[stage] = self.seconds.get(stage, 0.0) + seconds
        atomic_write(self._path, json.dumps(self.seconds))
