"""The data folder of an embedded service: its lock, its paths and its logs."""

import fcntl
import hashlib
import os
import shutil
import socket
import tempfile
import time
from pathlib import Path

from splatmill.process import start_time

_SOCKET_LIMIT = 100  # sun_path holds 108 bytes on Linux, 104 on macOS
_LOG_BYTES = 10 << 20  # a larger log is renamed when its process starts
_DYING_SECONDS = 10.0  # for the Redis of a supervisor that was killed to end


class UpError(Exception):
    """The service cannot start. The message says why, and what to do."""


class DataFolder:
    """The data folder, locked by this process. Raises UpError if it cannot be written or is in use.

    `lock` is the descriptor of the lock file. A child that inherits it holds the lock until it ends, too.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.expanduser().absolute()
        try:
            for folder in (self.path, self.redis, self.logs):
                folder.mkdir(parents=True, exist_ok=True)
            probe = self.path / f".probe-{os.getpid()}"
            probe.write_bytes(b"ok")
            probe.unlink()
            self.lock = os.open(self.path / "up.lock", os.O_RDWR | os.O_CREAT, 0o600)
        except OSError as error:
            raise UpError(
                f"The data folder {self.path} cannot be written: {error.strerror or error}. "
                "Choose another with --data, or let this user write there."
            ) from error
        self._take()
        self._sockets = self._socket_folder()

    @property
    def redis(self) -> Path:
        """The folder of the append-only log of Redis."""
        return self.path / "redis"

    @property
    def logs(self) -> Path:
        """The folder of the logs, one file per child."""
        return self.path / "logs"

    @property
    def redis_socket(self) -> Path:
        return self._sockets / "redis.sock"

    @property
    def renderer_socket(self) -> Path:
        return self._sockets / "renderer.sock"

    def log(self, name: str) -> int:
        """Open the log of a child to append to it, and return the descriptor; a large log is renamed first."""
        path = self.logs / f"{name}.log"
        if path.exists() and path.stat().st_size > _LOG_BYTES:
            path.replace(path.with_suffix(".old.log"))
        return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)

    def log_end(self, name: str, lines: int = 6) -> str:
        """Return the last lines of a child's log."""
        try:
            text = (self.logs / f"{name}.log").read_text(errors="replace")
        except OSError:
            return ""
        return "\n".join(f"  {line}" for line in text.strip().splitlines()[-lines:])

    def close(self) -> None:
        """Release the folder."""
        if self._sockets != self.path:
            shutil.rmtree(self._sockets, ignore_errors=True)
        os.close(self.lock)

    def _take(self) -> None:
        deadline = time.monotonic() + _DYING_SECONDS
        while True:
            try:
                fcntl.flock(self.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                holder = os.pread(self.lock, 20, 0).decode(errors="replace").strip()
                alive = holder.isdigit() and start_time(int(holder)) is not None
                if alive or time.monotonic() > deadline:
                    raise UpError(
                        f"The data folder {self.path} is in use by another `splatmill up`"
                        + (f" (process {holder})" if alive else "")
                        + ". Use that one, stop it, or choose another folder with --data."
                    ) from None
                # That process is dead, but its Redis still writes its log.
                time.sleep(0.05)
        os.ftruncate(self.lock, 0)
        os.pwrite(self.lock, f"{os.getpid()}\n".encode(), 0)

    def _socket_folder(self) -> Path:
        if len(os.fsencode(self.path / "renderer.sock")) <= _SOCKET_LIMIT and _holds_sockets(self.path):
            return self.path
        digest = hashlib.sha256(os.fsencode(self.path)).hexdigest()[:12]
        folder = Path(tempfile.gettempdir()) / f"splatmill-{os.getuid()}-{digest}"
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
        if folder.is_symlink() or status.st_uid != os.getuid() or status.st_mode & 0o077:
            raise UpError(
                f"The folder {folder}, which is needed for private sockets, belongs to another "
                f"user or is open to others; "
                "remove it."
            )
        return folder


def _holds_sockets(folder: Path) -> bool:
    """Return whether a unix socket can be made in a folder; some network file systems allow none."""
    path = folder / f".probe-{os.getpid()}.sock"
    try:
        with socket.socket(socket.AF_UNIX) as probe:
            probe.bind(str(path))
    except OSError:
        return False
    finally:
        path.unlink(missing_ok=True)
    return True
