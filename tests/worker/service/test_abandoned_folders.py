"""Proves which work folders are removed: those of unknown jobs, and with an age, those of ended ones; none in use."""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import redis

from splatmill.backplane import keys
from splatmill.backplane.storage.storage import Storage
from splatmill_worker.service import abandoned_folders, job_folder
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


def test_folders_of_ended_jobs_are_removed_at_their_age(
    local: Storage, connection: redis.Redis, monkeypatch: pytest.MonkeyPatch
) -> None:
    ages = {"ended000": 3.0, "active00": 3.0, "fresh000": 1.0, "working0": 3.0}
    for job_id, days in ages.items():
        folder = JobFolder(local, job_id, CAPTURE)
        os.utime(folder.path / "lock", (time.time() - days * 86400,) * 2)
        connection.hset(keys.job(job_id), "id", job_id)
        if job_id != "working0":
            folder.close()
        else:
            working = folder
    connection.sadd(keys.ACTIVE, "active00")
    assert remove_abandoned(connection) == []
    monkeypatch.setenv("SPLATMILL_KEEP_WORK", "2d")
    assert remove_abandoned(connection) == ["ended000"]
    working.close()
    assert remove_abandoned(connection) == ["working0"]


def test_a_job_that_is_restarted_at_the_same_moment_keeps_its_folder(
    local: Storage, connection: redis.Redis, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = JobFolder(local, "ended000", CAPTURE)
    folder.close()
    os.utime(folder.path / "lock", (1.0, 1.0))
    connection.hset(keys.job("ended000"), "id", "ended000")
    hold = job_folder.hold

    @contextmanager
    def restarted(path: Path) -> Iterator[bool]:
        with hold(path) as held:
            connection.sadd(keys.ACTIVE, "ended000")
            yield held

    monkeypatch.setattr(abandoned_folders, "hold", restarted)
    assert remove_abandoned(connection, keep=60.0) == []
    assert folder.path.is_dir()
