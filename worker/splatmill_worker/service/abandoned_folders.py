"""Removes job folders that no attempt needs: those of deleted jobs, which the server cannot remove on another
machine, and those of ended jobs that have reached an age.
"""

import shutil
import time
from pathlib import Path

import redis

from splatmill.backplane import keys, layout
from splatmill_worker.service.job_folder import hold
from splatmill_worker.settings import data_folder, keep_work

KEEP_SECONDS = 24 * 3600
"""Seconds since its last attempt for which the folder of an unknown job is kept. The worker may have been pointed to
another Redis by mistake, which does not know the jobs of the usual one."""


def remove_abandoned(connection: redis.Redis, keep: float | None = None) -> list[str]:
    """Remove folders that no attempt uses, and return the ids of their jobs.

    keep: age in seconds since the last attempt at which the folder of a job that has ended is removed; None, the
    default, is SPLATMILL_KEEP_WORK. Without an age, only folders of unknown jobs are removed, after KEEP_SECONDS.

    A folder is removed under its lock, after another look at the job: one that is restarted at the same moment keeps
    its folder, or begins with a new one.
    """
    keep = keep_work() if keep is None else keep
    removed = []
    work = data_folder() / "work"
    for folder in sorted(work.iterdir()) if work.is_dir() else ():
        if layout.is_id(folder.name) and _is_due(connection, folder, keep):
            with hold(folder) as held:
                if held and _is_due(connection, folder, keep):
                    shutil.rmtree(folder, ignore_errors=True)
                    removed.append(folder.name)
    return removed


def _is_due(connection: redis.Redis, folder: Path, keep: float | None) -> bool:
    try:
        age = time.time() - (folder / "lock").stat().st_mtime
    except OSError:
        return False
    if not connection.exists(keys.job(folder.name)):
        return age > KEEP_SECONDS
    # The set of active jobs may hold ended ones for a few seconds, and holds every other one.
    return keep is not None and age > keep and not connection.sismember(keys.ACTIVE, folder.name)
