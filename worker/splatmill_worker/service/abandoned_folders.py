"""Removes from this machine's disk what no attempt needs: the folders of deleted jobs, which the server cannot remove
on another machine, those of ended jobs that have reached an age, and of all ended jobs what is made anew from storage.

What is left of a job that has ended is counted for its owner (`room`).
"""

import shutil
import time
from pathlib import Path

import redis

from splatmill.backplane import keys
from splatmill.backplane.jobs import events
from splatmill.backplane.jobs import row as rows
from splatmill.backplane.jobs.fold import fold
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.records import UnreadableRecord
from splatmill_worker.service.job_folder import LOCK_SECONDS, bytes_in, hold, remove_remade, tile_folders
from splatmill_worker.service.room import is_counted, leave
from splatmill_worker.settings import data_folder, keep_work, work_folder

KEEP_SECONDS = 24 * 3600
"""Seconds since its last attempt for which the folder of an unknown job is kept, unless Redis says that the job was
deleted. The worker may have been pointed to another Redis by mistake, which does not know the jobs of the usual one."""


def remove_abandoned(connection: redis.Redis, keep: float | None = None) -> list[str]:
    """Remove folders that no attempt uses, and return the ids of their jobs.

    keep: age in seconds since the last attempt at which the folder of a job that has ended is removed; None, the
    default, is SPLATMILL_KEEP_WORK. Without an age, only folders of unknown jobs are removed, after KEEP_SECONDS.

    A folder is removed under its lock, after another look at the job: one that is restarted at the same moment keeps
    its folder, or begins with a new one. Folders that are kept lose what is made anew, unless their job is unfinished.
    """
    keep = keep_work() if keep is None else keep
    removed = []
    work = data_folder() / "work"
    for folder in sorted(work.iterdir()) if work.is_dir() else ():
        of_tiles = folder.name.partition("_")[0]
        if folder.name != of_tiles and layout.is_id(of_tiles) and not _is_active(connection, of_tiles):
            _remove_unheld(folder)
            continue
        if not layout.is_id(folder.name) or _is_active(connection, folder.name):
            continue
        with hold(folder) as held:
            if not held or _is_active(connection, folder.name):
                continue
            owner = _owner(connection, folder.name)
            if _is_due(connection, folder, keep):
                shutil.rmtree(folder, ignore_errors=True)
                removed.append(folder.name)
                if owner is not None:
                    leave(connection, owner, folder.name, 0)
                continue
            less = remove_remade(folder)
            if owner is not None and (less or not is_counted(connection, owner, folder.name)):
                leave(connection, owner, folder.name, bytes_in(folder))
    return removed


def tidy(connection: redis.Redis, job_id: str) -> None:
    """Remove what is made anew from the folder of a job whose attempt has just ended, if no other is to follow."""
    folder = work_folder(job_id)
    tiles = tile_folders(job_id)
    if not (folder.is_dir() or tiles) or not _is_over(connection, job_id):
        return
    for path in tiles:
        _remove_unheld(path)
    # What the attempt started has been killed, and may hold the lock for a moment.
    with hold(folder, seconds=LOCK_SECONDS) as held:
        if held:
            remove_remade(folder)
            if (owner := _owner(connection, job_id)) is not None:
                leave(connection, owner, job_id, bytes_in(folder))


def _remove_unheld(folder: Path) -> None:
    """Remove a folder of tiles, unless a process does one in it."""
    with hold(folder) as held:
        if held:
            shutil.rmtree(folder, ignore_errors=True)


def _is_over(connection: redis.Redis, job_id: str) -> bool:
    """Return whether a job has ended, is to be cancelled, or is not known."""
    try:
        row = rows.read(connection, job_id)
    except UnreadableRecord:
        return False
    if row is None or row.cancel_requested_at is not None:
        return True
    return fold(row, events.read_states(connection, job_id)).state.final


def _is_active(connection: redis.Redis, job_id: str) -> bool:
    # The set of active jobs may hold ended ones for a few seconds, and holds every other one.
    return bool(connection.sismember(keys.ACTIVE, job_id))


def _is_due(connection: redis.Redis, folder: Path, keep: float | None) -> bool:
    try:
        age = time.time() - (folder / "lock").stat().st_mtime
    except OSError:
        return False
    if not connection.exists(keys.job(folder.name)):
        deleted = connection.get(keys.deleting(f"model/{folder.name}")) == keys.DELETED
        return deleted or age > KEEP_SECONDS
    return keep is not None and age > keep


def _owner(connection: redis.Redis, job_id: str) -> str | None:
    """Return the owner of a job, or None for a job that is not known."""
    try:
        row = rows.read(connection, job_id)
    except UnreadableRecord:
        return None
    return None if row is None else row.owner
