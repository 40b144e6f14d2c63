"""The local folder of a job: its photos, its checkpoints, and what is to be published.

    work/{job}/capture/{images,masks,poses}/...   the capture, linked or downloaded
    work/{job}/run/...                            the pipeline's own: checkpoints, reconstruction, out/
    work/{job}/lock                               held by the attempt's process, whatever Redis may say

It outlives attempts, so that the next one goes on. Where storage is not a folder of this machine, what the next
attempt needs is also copied there, for it may run elsewhere.
"""

import fcntl
import os
import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path

from splatmill.backplane import layout
from splatmill.backplane.storage import Storage, StorageError
from splatmill_worker.errors import ModelNotStored
from splatmill_worker.settings import work_folder

MIRROR_SECONDS = 15.0
"""Between two looks for new checkpoints to copy; one more loss than the checkpoint interval itself."""

LOCK_SECONDS = 10.0
"""How long to wait for a process that is being killed to let go of the folder."""

START, FILM, CHECKPOINTS = "start.ply", "film", "checkpoints"

MIRRORED = (START, CHECKPOINTS, "plan.json", "stages.json", FILM)
"""Cameras are not among them: `reconstruction` shares those with every job on the capture."""

_RECONSTRUCTION = "sfm"


class FolderInUseError(RuntimeError):
    """Another process works at the same job on this machine."""


class Workspace:
    """The folder of one job, locked for this process. `run` and `capture` are the pipeline's two folders."""

    def __init__(self, storage: Storage, job_id: str, capture_id: str) -> None:
        self.storage = storage
        self.job_id = job_id
        self.capture_id = capture_id
        self.folder = work_folder(job_id)
        self.folder.mkdir(parents=True, exist_ok=True)
        self.capture = self.folder / "capture"
        self.run = self.folder / "run"
        self._lock = _locked(self.folder / "lock")

    def stage_in(self) -> int:
        """Bring the capture here, by links where storage is a local folder. Returns the number of files."""
        prefix = layout.capture_files(self.capture_id)
        entries = list(self.storage.entries(prefix))
        wanted = {entry.path[len(prefix) + 1 :]: entry for entry in entries}
        for path in self.capture.rglob("*") if self.capture.is_dir() else ():
            if not path.is_dir() and path.relative_to(self.capture).as_posix() not in wanted:
                path.unlink()
        for name, entry in wanted.items():
            target = self.capture / name
            if target.is_file() and target.stat().st_size == entry.size:
                continue
            source = self.storage.local_path(entry.path)
            if source is None:
                self.storage.download(entry.path, target)
            else:
                _link(source, target)
        return len(entries)

    def stage_start(self, model_id: str) -> None:
        """Bring a finished model's .ply here to start from, as run/start.ply. Raises ModelNotStored without one."""
        target = self.run / START
        if target.is_file():
            return
        path = layout.model_file(model_id, "model.ply") if layout.is_id(model_id) else None
        if path is None or self.storage.head(path) is None:
            raise ModelNotStored(model_id)
        source = self.storage.local_path(path)
        if source is None:
            self.storage.download(path, target)
        else:
            _kept(source, target)

    def restore(self) -> list[str]:
        """Fetch what an attempt on another machine left, if this one has nothing of its own. Returns the names.

        A run without a checkpoint begins anew: the film of the one before is dropped, here from storage.
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
            self.storage.delete_prefix(f"{stored}/{FILM}")
        return [] if own else self.storage.download_prefix(stored, self.run)

    def close(self) -> None:
        """Let go of the folder and leave it as it is."""
        os.close(self._lock)

    def remove(self) -> None:
        """The job is over: nothing here is needed again."""
        shutil.rmtree(self.folder, ignore_errors=True)
        if self.storage.root is None:
            self.storage.delete_prefix(layout.job_work(self.job_id))

    def start_over(self) -> None:
        """Drop what led to a failure, so that a restarted job is trained anew; its cameras stay."""
        for path in self.run.iterdir() if self.run.is_dir() else ():
            if path.name != _RECONSTRUCTION:
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        if self.storage.root is None:
            self.storage.delete_prefix(layout.job_work(self.job_id))


Warn = Callable[[str], None]


class Mirror:
    """Copies new checkpoints to storage while the pipeline runs, for an attempt that may follow elsewhere.

    Does nothing where storage is a local folder. A failed copy is reported to `warn` and tried again.
    """

    def __init__(self, workspace: Workspace, warn: Warn) -> None:
        self._workspace = workspace
        self._warn = warn
        self._copied: dict[Path, tuple[int, int]] = {}
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        if workspace.storage.root is None:
            self._thread = threading.Thread(target=self._loop, name="mirror", daemon=True)
            self._thread.start()

    def close(self, copy: bool) -> None:
        """End; with `copy`, first bring storage up to date."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            if copy:
                self._copy()

    def _loop(self) -> None:
        while not self._stop.wait(MIRROR_SECONDS):
            self._copy()

    def _copy(self) -> None:
        run, storage = self._workspace.run, self._workspace.storage
        for path in _files_of([run / name for name in MIRRORED]):
            try:
                state = path.stat()
            except FileNotFoundError:
                continue
            version = (state.st_mtime_ns, state.st_size)
            if path.name.startswith(".") or self._copied.get(path) == version:
                continue
            name = path.relative_to(run).as_posix()
            try:
                storage.put(f"{layout.job_work(self._workspace.job_id)}/{name}", path)
            except (StorageError, FileNotFoundError) as error:
                self._warn(f"{name} could not be copied to storage: {error}")
            else:
                self._copied[path] = version


def _files_of(paths: list[Path]) -> list[Path]:
    """The files among `paths` and below them."""
    below = [child for path in paths if path.is_dir() for child in path.rglob("*")]
    return sorted(path for path in (*paths, *below) if path.is_file())


def _locked(path: Path) -> int:
    """Hold an exclusive lock on a file until its descriptor is closed, at the latest with this process; wait while
    a dying one still has it."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT, 0o644)
    path.touch()  # its time says when the last attempt began
    deadline = time.monotonic() + LOCK_SECONDS
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return descriptor
        except BlockingIOError:
            if time.monotonic() > deadline:
                os.close(descriptor)
                raise FolderInUseError(f"Another process works in {path.parent}.") from None
            time.sleep(0.05)


def in_use(folder: Path) -> bool:
    """Whether a process works in a job's folder now."""
    try:
        with (folder / "lock").open("a") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except FileNotFoundError:
        return False
    return False


def _link(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    target.unlink(missing_ok=True)
    try:
        # A hard link stays good when the capture is deleted while the job runs.
        os.link(source, target)
    except OSError:
        target.symlink_to(source)


def _kept(source: Path, target: Path) -> None:
    """A link to `source`, or a copy where none can be made: later attempts read it when the source is gone."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:
        part = target.with_name(f".{target.name}.part")
        shutil.copy2(source, part)
        part.replace(target)
