"""Copies stored files into a job's folder, several at a time from a bucket: a capture, or what attempts have left."""

import threading
from collections.abc import Callable, Mapping
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import suppress
from pathlib import Path

from splatmill.backplane.storage.storage import Entry, Storage
from splatmill_worker.service.own_copy import link_or_copy

DOWNLOADS = 8
"""Files that are downloaded at a time: most of the time of a small one is the wait for the bucket's answer."""

Report = Callable[[int, int], None]
"""Told the numbers of files that are there and of all files. May be called by several threads, one at a time. Its
errors end the staging."""


def is_whole(path: Path, entry: Entry) -> bool:
    """Return whether `path` is a file of its own, not a symbolic link, with the size of the stored one."""
    return path.is_file() and not path.is_symlink() and path.stat().st_size == entry.size


def stage(storage: Storage, files: Mapping[Path, Entry], report: Report) -> None:
    """Make each path a file with the bytes of its entry, unless it is one already.

    Files of a local storage are linked, or copied where it lies on another file system. One that is deleted from
    storage meanwhile, or is both a file and a folder, which buckets allow, is left out. Raises StorageError, OSError,
    and what `report` raises; files that are under way then are finished first.
    """
    missing = {path: entry for path, entry in files.items() if not is_whole(path, entry)}
    done = len(files) - len(missing)
    lock, stopped = threading.Lock(), threading.Event()

    def bring(path: Path, entry: Entry) -> None:
        nonlocal done
        if stopped.is_set():
            return
        source = storage.local_path(entry.path)
        try:
            with suppress(FileNotFoundError, FileExistsError, NotADirectoryError, IsADirectoryError):
                if source is None:
                    storage.download(entry.path, path)
                else:
                    link_or_copy(source, path)
            with lock:
                done += 1
                report(done, len(files))
        except BaseException:
            stopped.set()
            raise

    if storage.root is not None:
        for path, entry in missing.items():
            bring(path, entry)
        return
    with ThreadPoolExecutor(DOWNLOADS, thread_name_prefix="staging") as pool:
        tasks = [pool.submit(bring, path, entry) for path, entry in missing.items()]
        wait(tasks, return_when=FIRST_EXCEPTION)
    for task in tasks:
        task.result()


def fetch(storage: Storage, files: Mapping[Path, Entry]) -> None:
    """Make each path a file with the bytes of its entry, whatever was there, as `stage` does.

    Raises FileNotFoundError for a file that is deleted from storage meanwhile.
    """
    for path in files:
        path.unlink(missing_ok=True)
    stage(storage, files, lambda done, total: None)
    for path, entry in files.items():
        if not path.is_file():
            raise FileNotFoundError(f"{entry.path} was deleted from storage while it was being read.")
