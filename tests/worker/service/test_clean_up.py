"""Proves which work folders are removed: only those that are old, unused, and of a job that Redis does not know."""

import os
import time

import redis

from splatmill.backplane import keys
from splatmill.backplane.storage import Storage
from splatmill_worker.service import clean_up as sweep
from splatmill_worker.service.workspace import Workspace

CAPTURE = "capture1"


def test_the_sweep_takes_only_what_nobody_will_miss(local: Storage, connection: redis.Redis) -> None:
    old = time.time() - 2 * sweep.KEEP_SECONDS
    folders = {}
    for job_id in ("deleted0", "known000", "recent00", "working0"):  # the last stays open
        space = Workspace(local, job_id, CAPTURE)
        if job_id != "working0":
            space.close()
        if job_id != "recent00":
            os.utime(space.folder / "lock", (old, old))
        folders[job_id] = space
    connection.hset(keys.job("known000"), "id", "known000")
    assert sweep.sweep(connection) == ["deleted0"]
    assert not folders["deleted0"].folder.exists()
    assert sweep.sweep(connection) == []
