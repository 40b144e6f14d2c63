"""Proves which work folders are removed: only those that are old, unused, and of a job that Redis does not know."""

import os
import time

import redis

from splatmill.backplane import keys
from splatmill.backplane.storage import Storage
from splatmill_worker.service.abandoned_folders import KEEP_SECONDS, remove_abandoned
from splatmill_worker.service.job_folder import JobFolder
from tests.support.jobs import CAPTURE


def test_only_old_unused_folders_of_unknown_jobs_are_removed(local: Storage, connection: redis.Redis) -> None:
    old = time.time() - 2 * KEEP_SECONDS
    folders = {}
    for job_id in ("deleted0", "known000", "recent00", "working0"):  # the last stays open
        folder = JobFolder(local, job_id, CAPTURE)
        if job_id != "working0":
            folder.close()
        if job_id != "recent00":
            os.utime(folder.path / "lock", (old, old))
        folders[job_id] = folder
    connection.hset(keys.job("known000"), "id", "known000")
    assert remove_abandoned(connection) == ["deleted0"]
    assert not folders["deleted0"].path.exists()
    assert remove_abandoned(connection) == []
