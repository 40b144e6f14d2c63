"""The data folder of an embedded service: who has it, and where in it things lie."""

import fcntl
import hashlib
import os
import shutil
import tempfile
import time
from pathlib import Path

from splatmill.backplane.process import start_time

_SOCKET_LIMIT = 100  # sun_path holds 108 bytes on Linux, 104 on macOS
_LOG_BYTES = 10 << 20
_DYING_SECONDS = 10.0


class UpError(Exception):
    """The service cannot start; the text says why and what to do."""


class DataFolder:
    """The folder, held for the life of this process. Raises UpError when it cannot be written or is in use.

    `lock` is the open lock file: a child that inherits it keeps the folder taken until it has ended too.
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
        """Redis's append-only log."""
        return self.path / "redis"

    @property
    def logs(self) -> Path:
        """One file per child."""
        return self.path / "logs"

    @property
    def redis_socket(self) -> Path:
        return self._sockets / "redis.sock"

    @property
    def renderer_socket(self) -> Path:
        return self._sockets / "renderer.sock"

    def log(self, name: str) -> int:
        """An open file descriptor at the end of a child's log; a long log is put aside first."""
        path = self.logs / f"{name}.log"
        if path.exists() and path.stat().st_size > _LOG_BYTES:
            path.replace(path.with_suffix(".old.log"))
        return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)

    def last_words(self, name: str, lines: int = 6) -> str:
        """The end of a child's log."""
        try:
            text = (self.logs / f"{name}.log").read_text(errors="replace")
        except OSError:
            return ""
        return "\n".join(f"  {line}" for line in text.strip().splitlines()[-lines:])

    def close(self) -> None:
        """Give the folder up."""
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
                # That process is dead; its Redis is still putting its log away.
                time.sleep(0.05)
        os.ftruncate(self.lock, 0)
        os.pwrite(self.lock, f"{os.getpid()}\n".encode(), 0)

    def _socket_folder(self) -> Path:
        if len(os.fsencode(self.path / "renderer.sock")) <= _SOCKET_LIMIT:
            return self.path
        digest = hashlib.sha256(os.fsencode(self.path)).hexdigest()[:12]
        folder = Path(tempfile.gettempdir()) / f"splatmill-{os.getuid()}-{digest}"
        folder.mkdir(mode=0o700, exist_ok=True)
        seen = folder.lstat()
        if folder.is_symlink() or seen.st_uid != os.getuid() or seen.st_mode & 0o077:
            raise UpError(f"{folder}, which is to hold private sockets, belongs to somebody else; remove it.")
        return folder
