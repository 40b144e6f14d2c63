"""The local folder of a job: its photos, its checkpoints, and the model to be stored.

    work/{job}/capture/{images,masks,poses}/...   the capture, linked, copied or downloaded
    work/{job}/run/...                            what the pipeline writes: checkpoints, cameras, out/
    work/{job}/lock                               locked by the attempt's process, independently of Redis

The folder outlives an attempt, so that the next one resumes. `mirror` copies what it needs to storage as well, where
storage is not a folder of this machine.
"""

import fcntl
import itertools
import os
import shutil
import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Entry, Storage
from splatmill.schema import TIME_LAPSE
from splatmill_worker.errors import CaptureIncomplete, FolderInUse, StartNotStored
from splatmill_worker.service.disk_reserve import shortage
from splatmill_worker.service.own_copy import link_or_copy
from splatmill_worker.service.staging import Report, fetch, is_whole, stage
from splatmill_worker.settings import work_folder
from splatmill_worker.tiles.folder import LEFT_BY_KILLED, TILES, UNITS

LOCK_SECONDS = 10.0
"""Seconds to wait for the folder's lock, which a process that is being killed still holds for a moment."""

START, FILM, CHECKPOINTS, SNAPSHOTS = "start.ply", "film", "checkpoints", TIME_LAPSE
"""Names in the run folder: the model to start from, the frames of the progress film, the checkpoints, and the snapshots
of the time-lapse."""

ENDED = "ended_decoders.json"
"""Name in the run folder of the list of files that are not opened again (`images.decoding.decoders`)."""

_CAMERAS = "sfm"

_RESTORING = "restoring"
"""Name beside the run folder of what comes from storage to become it."""

_REMADE = ("capture", _RESTORING, "run/unpacked", "run/frames", f"run/{START}")
"""What an attempt makes anew from storage: the capture, what its zips and videos hold, and the model to start from."""


class JobFolder:
    """The folder of one job, locked for this process until it is closed or the process ends.

    storage: where the capture lies and the model goes.
    path: the folder.
    capture: the folder of the photos, which the pipeline reads.
    run: the folder that the pipeline writes to.

    Raises FolderInUse when another process holds the lock for longer than LOCK_SECONDS.
    """

    def __init__(self, storage: Storage, job_id: str, capture_id: str) -> None:
        self.storage = storage
        self.job_id = job_id
        self.capture_id = capture_id
        self.path, self._lock = self._opened()
        self.capture = self.path / "capture"
        self.run = self.path / "run"

    def _opened(self) -> tuple[Path, int]:
        """The folder, and the descriptor of its lock."""
        path = work_folder(self.job_id)
        return path, _locked_folder(path)

    def stage_capture(
        self, report: Report = lambda done, total: None, only: Collection[str] | None = None
    ) -> int:
        """Make the capture folder equal to the stored capture; return the number of its files.

        only: names of the files that are wanted; None: all.

        Raises CaptureIncomplete when a stored file is not in the folder afterwards, and as `staging.stage`, which calls
        `report`.
        """
        prefix = layout.capture_files(self.capture_id)
        entries = {
            self.capture / name: entry
            for entry in self.storage.entries(prefix)
            if (name := entry.path[len(prefix) + 1 :]) and (only is None or name in only)
        }
        for path in self.capture.rglob("*") if self.capture.is_dir() else ():
            if not path.is_dir() and path not in entries:
                path.unlink()
        self.check_space(entries)
        stage(self.storage, entries, report)
        missing = [
            path.relative_to(self.capture).as_posix()
            for path, entry in entries.items()
            if not is_whole(path, entry)
        ]
        if missing:
            raise CaptureIncomplete(self.capture_id, missing, len(entries))
        return len(entries)

    def check_space(self, files: Mapping[Path, Entry]) -> None:
        """Raise DiskReserveReached if copies of the files that are missing would not fit beside the reserve."""
        root = self.storage.root
        if root is not None and root.stat().st_dev == self.path.stat().st_dev:
            return  # they are linked
        missing = sum(entry.size for path, entry in files.items() if not is_whole(path, entry))
        if missing and (short := shortage(missing)) is not None:
            raise short

    def stage_start(self, model_id: str) -> None:
        """Make a stored model available as run/start.ply. Raises StartNotStored when there is no such model."""
        target = self.run / START
        if target.is_file():
            return
        path = layout.model_file(model_id, "model.ply") if layout.is_id(model_id) else None
        if path is None or self.storage.head(path) is None:
            raise StartNotStored(model_id)
        source = self.storage.local_path(path)
        if source is None:
            self.storage.download(path, target)
        else:
            link_or_copy(source, target)

    def restore(self) -> list[str]:
        """Download the files that an attempt on another machine stored, if this machine has none. Return their names.

        Without a checkpoint the training starts anew, so film frames and snapshots of the earlier training are first
        deleted from storage.
        """
        if self.storage.root is not None:
            return []
        stored = layout.job_work(self.job_id)
        own = self.run.is_dir()
        if own:
            resumes = (self.run / CHECKPOINTS).is_dir()
        else:
            resumes = any(True for _ in self.storage.entries(f"{stored}/{CHECKPOINTS}"))
        if not resumes:
            for name in (FILM, SNAPSHOTS):
                self.storage.delete_prefix(f"{stored}/{name}")
        if own:
            return []
        # Renamed when it is whole: a part of it would pass for what an attempt on this machine left.
        part = self.path / _RESTORING
        shutil.rmtree(part, ignore_errors=True)
        units = layout.job_units(self.job_id)  # which a scene in tiles fetches itself
        entries = {
            entry.path[len(stored) + 1 :]: entry
            for entry in self.storage.entries(stored)
            if not entry.path.startswith(f"{units}/")
        }
        fetch(self.storage, {part / name: entry for name, entry in entries.items()})
        if entries:
            part.rename(self.run)
        return list(entries)

    def close(self) -> None:
        """Release the lock and keep the folder."""
        os.close(self._lock)

    def remove(self) -> None:
        """Delete the folder, and what was stored for other machines: the job has ended."""
        self._delete_stored()
        shutil.rmtree(self.path, ignore_errors=True)

    def reset(self) -> None:
        """Delete what the failed attempt stored, so that a restarted job trains anew. Recovered cameras stay, and so do
        the units of a scene in tiles that are done.
        """
        units = layout.job_units(self.job_id)
        for entry in self.storage.entries(layout.job_work(self.job_id)) if self.storage.root is None else ():
            if not entry.path.startswith(f"{units}/"):
                self.storage.delete(entry.path)
        for path in self.run.iterdir() if self.run.is_dir() else ():
            if path.name not in (_CAMERAS, TILES):
                shutil.rmtree(path) if path.is_dir() else path.unlink()

    def _delete_stored(self) -> None:
        # Without a bucket, nothing is stored for other machines but the units of a scene in tiles.
        if self.storage.root is None or (self.run / TILES).exists():
            self.storage.delete_prefix(layout.job_work(self.job_id))


class TileFolder(JobFolder):
    """A folder of tiles of a job that another worker has: what units have made.

    It is one of several, `work/{job}_1` and so on, as many as processes on this machine do tiles of the job at a time.
    It is kept for the next tile.
    """

    def _opened(self) -> tuple[Path, int]:
        for number in itertools.count(1):
            path = work_folder(f"{self.job_id}_{number}")
            with suppress(FolderInUse):
                return path, _locked_folder(path, seconds=0.0)
        raise AssertionError("count has no end")

    def remove(self) -> None:
        """Delete the folder: the job has ended."""
        shutil.rmtree(self.path, ignore_errors=True)


def tile_folders(job_id: str) -> list[Path]:
    """The folders on this machine of tiles of a job that another worker has."""
    return sorted(work_folder(job_id).parent.glob(f"{job_id}_*"))


def remove_remade(folder: Path) -> bool:
    """Delete what an attempt would make anew; return whether there was any. The caller holds the folder's lock."""
    paths = [path for name in _REMADE if (path := folder / name).exists()]
    paths += [path for name in LEFT_BY_KILLED for path in (folder / "run" / TILES / UNITS).glob(name)]
    for path in paths:
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
    return bool(paths)


def bytes_in(folder: Path) -> int:
    """Return the bytes of all files in a folder that have no other name, as links to a stored capture have."""
    size = 0
    for place, _, names in os.walk(folder):
        for name in names:
            with suppress(FileNotFoundError):
                state = os.lstat(os.path.join(place, name))
                size += state.st_size if state.st_nlink == 1 else 0
    return size


@contextmanager
def hold(folder: Path, seconds: float = 0.0) -> Iterator[bool]:
    """Hold the lock of a job's folder while the context is open; yield False if there is none, or if it is held.

    seconds: how long to wait for a lock that is held.
    """
    try:
        descriptor = os.open(folder / "lock", os.O_WRONLY)
    except FileNotFoundError:
        yield False
        return
    try:
        yield _acquired(descriptor, seconds)
    finally:
        os.close(descriptor)


def _locked_folder(folder: Path, seconds: float = LOCK_SECONDS) -> int:
    """Make a folder if there is none, lock it, and return the descriptor of its lock.

    A folder that is being removed is waited for, and made anew.
    """
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):
            descriptor = _locked(folder / "lock", seconds)
            if os.fstat(descriptor).st_nlink:
                return descriptor
            os.close(descriptor)


def _locked(path: Path, seconds: float) -> int:
    """Lock a file exclusively and return its descriptor. The lock ends when that is closed, also by a kill."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT, 0o644)
    path.touch()  # its modification time is the start of the last attempt
    if not _acquired(descriptor, seconds):
        os.close(descriptor)
        raise FolderInUse(path.parent)
    return descriptor


def _acquired(descriptor: int, seconds: float) -> bool:
    """Lock a file, and return whether that succeeded within this time."""
    deadline = time.monotonic() + seconds
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            if time.monotonic() >= deadline:
                return False
            time.sleep(0.05)
