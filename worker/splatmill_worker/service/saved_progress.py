"""Whether an attempt has stored a new checkpoint, as its parent process sees it in the job's folder."""

from pathlib import Path

from splatmill_worker.service.job_folder import CHECKPOINTS
from splatmill_worker.settings import work_folder
from splatmill_worker.tiles.folder import DONE, TILES, UNITS


class SavedProgress:
    """The checkpoints of one attempt and the units of its scene in tiles, from before its process begins.

    A job that this machine has no folder of may begin with a download of the last checkpoint, which is no progress:
    the first one to appear is then not counted.
    """

    def __init__(self, job_id: str) -> None:
        run = work_folder(job_id) / "run"
        self._run = run
        self._may_download = not run.is_dir()
        self._latest = self._newest()

    def advanced(self) -> bool:
        """Return whether the attempt has stored a checkpoint since the last call."""
        newest = self._newest()
        if newest == self._latest:
            return False
        self._latest = newest
        downloaded, self._may_download = self._may_download, False
        return not downloaded

    def _newest(self) -> int:
        """Return the newest modification time of a checkpoint or unit in nanoseconds; 0 without one."""
        saved = [*(self._run / CHECKPOINTS).glob("[!.]*"), *(self._run / TILES / UNITS).glob(f"[!.]*/{DONE}")]
        return max(map(_modified, saved), default=0)


def _modified(path: Path) -> int:
    try:
        return path.stat().st_mtime_ns
    except FileNotFoundError:
        return 0  # replaced at this moment
