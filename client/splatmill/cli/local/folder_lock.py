"""The lock of a data folder, which is held by one `splatmill train` and its service at a time."""

import json
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from splatmill.errors import ServiceFailed

ENDING_SECONDS = 60.0
"""Seconds for which the service of a command that was killed may still save its training."""

_POLL_SECONDS = 0.1


@contextmanager
def locked(data: Path) -> Iterator[int]:
    """Hold the lock of the folder `data`, and yield its file descriptor, for the service to inherit.

    The lock is a file beside the folder, so that it stays while the folder is removed. Raises ServiceFailed if another
    command holds it, or if the service of a command that was killed does not end within ENDING_SECONDS.
    """
    data.parent.mkdir(parents=True, exist_ok=True)
    path = data.with_name(data.name + ".lock")
    descriptor = _take(path, data.parent)
    try:
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, json.dumps({"pid": os.getpid(), "host": socket.gethostname()}).encode(), 0)
        yield descriptor
    finally:
        path.unlink(missing_ok=True)
        os.close(descriptor)


def _take(path: Path, folder: Path) -> int:
    import fcntl  # missing on Windows, where only --server works

    deadline = time.monotonic() + ENDING_SECONDS
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = _holder(descriptor)
            os.close(descriptor)
            if holder is None or _runs(holder):
                named = f" (process {holder})" if holder else ""
                raise ServiceFailed(
                    f"Another `splatmill train`{named} is writing to {folder}.",
                    "Choose another folder with -o, or wait until it has ended.",
                ) from error
            if time.monotonic() > deadline:
                raise ServiceFailed(
                    f"An earlier `splatmill train` was killed, and its service in {folder} does not end.",
                    "End the processes `splatmill_server.up` that are left, or choose another folder with -o.",
                ) from error
            time.sleep(_POLL_SECONDS)
            continue
        except OSError as error:
            os.close(descriptor)
            raise ServiceFailed(
                f"Files in {folder} cannot be locked: {error.strerror}.",
                "Choose a folder on another disk with -o.",
            ) from error
        if _is_at(descriptor, path):
            return descriptor
        os.close(descriptor)  # the holder before removed this file after it was opened here


def _holder(descriptor: int) -> int | None:
    """Return the process that holds the lock, or None if it is unknown or on another machine."""
    try:
        holder = json.loads(os.pread(descriptor, 1000, 0))
        return int(holder["pid"]) if holder["host"] == socket.gethostname() else None
    except (ValueError, KeyError, TypeError):
        return None


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


def _is_at(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False
