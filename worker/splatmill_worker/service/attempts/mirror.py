"""Copies the checkpoints of a running job to storage, for an attempt that may follow on another machine."""

import threading
import time
from collections.abc import Callable
from pathlib import Path

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import StorageError
from splatmill_worker.errors import QuotaReached
from splatmill_worker.service.job_folder import CHECKPOINTS, ENDED, FILM, SNAPSHOTS, START, JobFolder
from splatmill_worker.service.room import Room

INTERVAL = 15.0
"""Seconds between two looks for new files. Those are small, or never change, but the checkpoint."""

CHECKPOINT_INTERVAL = 60.0
"""Least seconds between the beginnings of two copies of the checkpoint, which changes as a whole: parameters, and
moments of Adam (decisions: CHECKPOINT_INTERVAL). Training that was done since the last copy is lost if the machine
fails; a stop copies it at once."""

CHECKPOINT_SHARE = 0.1
"""Largest share of the time that goes into copies of the checkpoint: a gigabyte over a slow line takes minutes."""

MIRRORED = (START, CHECKPOINTS, "plan.json", "stages.json", ENDED, FILM, SNAPSHOTS)
"""Files and folders of `run` that are copied. The recovered cameras are not among them: `sfm_cache` stores those."""


class Mirror:
    """The thread that copies new files of `folder.run` to storage while the pipeline runs.

    Where storage is a folder of this machine, nothing is copied. A failed copy is reported to `warn` and tried again,
    and so is one that has no room.
    """

    def __init__(self, folder: JobFolder, room: Room, warn: Callable[[str], None]) -> None:
        self._folder = folder
        self._room = room
        self._warn = warn
        self._copied: dict[Path, tuple[int, int]] = {}
        self._checkpoint_at = float("-inf")
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        if folder.storage.root is None:
            self._thread = threading.Thread(target=self._loop, name="mirror", daemon=True)
            self._thread.start()

    def close(self, copy: bool) -> None:
        """End the thread. With `copy`, bring storage up to date first."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            if copy:
                self._copy(all_files=True)

    def _loop(self) -> None:
        while not self._stop.wait(INTERVAL):
            self._copy(all_files=False)

    def _copy(self, *, all_files: bool) -> None:
        """Copy the new files. Unless `all_files`, the checkpoint is left out if its time has not come."""
        run = self._folder.run
        names = [name for name in MIRRORED if name != CHECKPOINTS]
        self._copy_files([run / name for name in names])
        began = time.monotonic()
        if (all_files or began >= self._checkpoint_at) and self._copy_files([run / CHECKPOINTS]):
            seconds = time.monotonic() - began
            self._checkpoint_at = began + max(CHECKPOINT_INTERVAL, seconds / CHECKPOINT_SHARE)

    def _copy_files(self, places: list[Path]) -> int:
        """Copy what has changed in files and folders, and return the number of files copied."""
        run, storage, copied = self._folder.run, self._folder.storage, 0
        for path in _files_in(places):
            try:
                state = path.stat()
            except FileNotFoundError:
                continue
            version = (state.st_mtime_ns, state.st_size)
            if path.name.startswith(".") or self._copied.get(path) == version:
                continue  # a leading dot marks a file that is still being written
            name = path.relative_to(run).as_posix()
            try:
                self._room.store({name: state.st_size})
                storage.put(f"{layout.job_work(self._folder.job_id)}/{name}", path)
            except (StorageError, FileNotFoundError, QuotaReached) as error:
                self._warn(f"{name} could not be copied to storage and will be tried again: {error}")
            else:
                self._copied[path] = version
                copied += 1
        return copied


def _files_in(paths: list[Path]) -> list[Path]:
    """Return the files among `paths` and below them, sorted."""
    below = [child for path in paths if path.is_dir() for child in path.rglob("*")]
    return sorted(path for path in (*paths, *below) if path.is_file())
