"""Removes the work folders of deleted jobs. The server that deletes a job may run on another machine."""

import shutil
import time

import redis

from splatmill.backplane import keys, layout
from splatmill_worker.service.workspace import in_use
from splatmill_worker.settings import data_folder

KEEP_SECONDS = 24 * 3600
"""A folder is kept this long after its last attempt even when its job is unknown: the job may be known to another
Redis, which this worker was not meant to be pointed away from."""


def sweep(connection: redis.Redis) -> list[str]:
    """Remove every folder whose job is gone, whose last attempt is a day old and in which nobody works."""
    removed = []
    work = data_folder() / "work"
    for folder in sorted(work.iterdir()) if work.is_dir() else ():
        lock = folder / "lock"
        if not (layout.is_id(folder.name) and lock.is_file()):
            continue
        old = time.time() - lock.stat().st_mtime > KEEP_SECONDS
        if old and not connection.exists(keys.job(folder.name)) and not in_use(folder):
            shutil.rmtree(folder, ignore_errors=True)
            removed.append(folder.name)
    return removed
