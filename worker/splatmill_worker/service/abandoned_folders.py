"""Removes the job folders of deleted jobs, which the server cannot do when it runs on another machine."""

import shutil
import time

import redis

from splatmill.backplane import keys, layout
from splatmill_worker.service.job_folder import in_use
from splatmill_worker.settings import data_folder

KEEP_SECONDS = 24 * 3600
"""Seconds since its last attempt for which the folder of an unknown job is kept. The worker may have been pointed to
another Redis by mistake, which does not know the jobs of the usual one."""


def remove_abandoned(connection: redis.Redis) -> list[str]:
    """Remove the folders of unknown jobs that are unused and older than KEEP_SECONDS. Return the ids of these jobs."""
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
