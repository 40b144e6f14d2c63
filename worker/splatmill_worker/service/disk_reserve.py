"""The space that a worker leaves free on the disk of its data folder, so that a full disk ends no job and no Redis.

An attempt stops and keeps its checkpoint before the reserve is used, and a worker takes no job until more is free.
"""

import shutil
import threading
from pathlib import Path

from splatmill.schema import format_bytes
from splatmill_worker.errors import DiskReserveReached
from splatmill_worker.settings import data_folder, disk_reserve

CHECK_SECONDS = 1.0


def shortage(needed: int = 0) -> DiskReserveReached | None:
    """Return the error if writing `needed` more bytes to the data folder would use the reserve, else None."""
    folder, reserve = data_folder(), disk_reserve()
    free = _free_bytes(folder)
    if free - needed >= reserve:
        return None
    return DiskReserveReached(folder, free, reserve, needed)


def spare_bytes() -> int:
    """Return the bytes that are free on the disk of the data folder beyond the reserve; negative if it is used."""
    return _free_bytes(data_folder()) - disk_reserve()


def shortage_text() -> str | None:
    """Return why a worker takes no job, or None if it may."""
    short = shortage()
    if short is None:
        return None
    return (
        f"{format_bytes(short.free)} are free on the disk of {short.folder}, and {format_bytes(short.reserve)} are "
        "reserved (SPLATMILL_DISK_RESERVE)"
    )


class DiskWatch:
    """Watches the disk while an attempt runs, in a thread.

    error: what to raise once the reserve was reached; None until then.
    """

    def __init__(self) -> None:
        self.error = shortage()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="disk-watch", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while self.error is None and not self._stop.wait(CHECK_SECONDS):
            self.error = shortage()


def _free_bytes(folder: Path) -> int:
    """Return the bytes that this user may still write to the file system of a folder, which need not exist yet."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return shutil.disk_usage(folder).free
