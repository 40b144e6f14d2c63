"""Proves how an attempt that storage refuses ends: queued again while it can be retried, failed by name when not. That
it waits for a job that Redis has lost. That photos reach structure from motion from a storage on another file system.
That garbage is collected while a pipeline runs, and not while it is imported.
That a list of files that end decoding processes reaches another machine.

Does not prove what happens to the processes: tests/service does.
"""

import json
import logging
import os
import shutil
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import pytest
import redis
from PIL import Image

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage, StorageError
from splatmill.schema import Role
from splatmill_worker.errors import UnusablePicture
from splatmill_worker.images.decoding import decoders
from splatmill_worker.service.attempts import run_attempt as module
from splatmill_worker.service.attempts.attempt import Attempt, start_attempt
from splatmill_worker.service.attempts.outbox import Outbox
from splatmill_worker.service.attempts.run_attempt import run_attempt
from splatmill_worker.service.command import _pipeline
from splatmill_worker.service.disk_reserve import DiskWatch
from splatmill_worker.service.job_folder import ENDED, JobFolder
from splatmill_worker.service.lock import JobLock
from splatmill_worker.service.process_exit import HANDED_BACK_STATUS
from splatmill_worker.service.room import Room
from tests.support.jobs import CAPTURE, messages, read_job, write_row

if TYPE_CHECKING:
    import _fleet.pipeline
    import _soak.pipeline

    import splatmill_worker.pipeline
    from tests.support.servers import standin

    # What an attempt may be told to run has to take what it passes: mypy compares them here.
    PIPELINES: list[module.Pipeline] = [
        splatmill_worker.pipeline.run,
        _fleet.pipeline.run,
        _soak.pipeline.run,
        standin.run,
    ]

JOB = "job00001"


@pytest.fixture
def refused(connection: redis.Redis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Attempt:
    """An attempt whose storage folder cannot be made, because a file is in its place."""
    (tmp_path / "file").touch()
    monkeypatch.setenv("SPLATMILL_STORAGE", (tmp_path / "file" / "storage").as_uri())
    monkeypatch.setattr(module, "RETRY_SECONDS", 0.0)
    monkeypatch.setattr(logging.getLogger("splatmill_worker"), "level", logging.WARNING)  # it is set for good
    write_row(connection, JOB)
    return start_attempt(connection, f"{JOB}-1", "token")


def test_a_transient_failure_is_raised_while_it_can_be_retried(
    refused: Attempt, connection: redis.Redis
) -> None:
    with pytest.raises(StorageError):
        run_attempt(refused, _pipeline, can_retry=True)
    job = read_job(connection, JOB)
    assert (job.state, job.attempt, job.problem) == ("queued", 1, None)
    assert any("tried again" in message for message in messages(connection, JOB))


def test_a_transient_failure_without_retries_left_is_the_jobs_problem(
    refused: Attempt, connection: redis.Redis
) -> None:
    run_attempt(refused, _pipeline, can_retry=False)
    job = read_job(connection, JOB)
    assert job.state == "failed"
    assert job.problem is not None
    assert job.problem.code == "storage_unavailable"
    assert job.problem.sentence in messages(connection, JOB)
    assert refused.lock.holder() is None


@pytest.fixture
def lost(connection: redis.Redis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Attempt:
    """An attempt at an unfinished job that Redis has lost, and storage has not."""
    monkeypatch.setenv("SPLATMILL_STORAGE", (tmp_path / "storage").as_uri())
    monkeypatch.setattr(logging.getLogger("splatmill_worker"), "level", logging.WARNING)
    Storage((tmp_path / "storage").as_uri()).put(layout.unfinished_job(JOB), b"{}")
    return start_attempt(connection, f"{JOB}-1", "token")


def test_a_job_that_redis_has_lost_begins_once_it_is_restored(lost: Attempt, connection: redis.Redis) -> None:
    restored = threading.Timer(0.3, write_row, (connection, JOB))
    restored.start()
    run_attempt(lost, _pipeline, can_retry=False)
    restored.join()
    job = read_job(connection, JOB)
    assert job.attempt == lost.number
    assert job.state == "failed"  # without photos
    assert job.problem is not None


def test_a_job_that_is_not_restored_goes_back_to_the_queue(
    lost: Attempt, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "RESTORE_SECONDS", 0.0)
    monkeypatch.setattr(os, "_exit", sys.exit)
    with pytest.raises(SystemExit) as ended:
        run_attempt(lost, _pipeline, can_retry=False)
    assert ended.value.code == HANDED_BACK_STATUS


def test_a_job_that_was_deleted_does_not_begin(lost: Attempt, tmp_path: Path) -> None:
    Storage((tmp_path / "storage").as_uri()).delete(layout.unfinished_job(JOB))
    run_attempt(lost, _pipeline, can_retry=False)
    assert lost.lock.holder() is None


def test_photos_reach_structure_from_motion_from_another_file_system(
    elsewhere: Storage, connection: redis.Redis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPLATMILL_STORAGE", elsewhere.url)
    monkeypatch.setattr(logging.getLogger("splatmill_worker"), "level", logging.WARNING)
    elsewhere.delete_prefix(layout.capture(CAPTURE))
    for grey in range(4):
        Image.new("RGB", (64, 48), 3 * (grey,)).save(tmp_path / "plain.png")
        elsewhere.put(layout.capture_file(CAPTURE, Role.images, f"{grey}.png"), tmp_path / "plain.png")
    write_row(connection, JOB)
    run_attempt(start_attempt(connection, f"{JOB}-1", "token"), _pipeline, can_retry=False)
    problem = read_job(connection, JOB).problem
    assert problem is not None
    assert (problem.code, problem.facts["photos"]) == ("sfm_no_features", 4), problem.detail


def test_the_files_that_end_decoders_are_known_to_an_attempt_on_another_machine(
    remote: Storage, room: Room, connection: redis.Redis, tmp_path: Path
) -> None:
    """Also when they are to be tried again: the list that an earlier attempt stored is replaced."""

    def ended(*arguments: object, **others: object) -> NoReturn:
        if not decoders.forget_ended():
            assert decoders._active is not None
            decoders._active._ended.add("capture/images/a.jpg", "it was ended twice")
        raise UnusablePicture("decoder_ended", "a.jpg", "it was ended twice")

    row = write_row(connection, JOB)
    attempt = Attempt(connection, JOB, 1, 1, JobLock(connection, JOB, "token"))
    for stored in ({"capture/images/a.jpg": "it was ended twice"}, {}):
        folder, disk, outbox = JobFolder(remote, JOB, CAPTURE), DiskWatch(), Outbox(attempt)
        try:
            with pytest.raises(UnusablePicture):
                module._train(attempt, lambda: ended, row, folder, room, disk, outbox)
        finally:
            outbox.close()
            disk.close()
            folder.close()
        assert json.loads(remote.get(f"{layout.job_work(JOB)}/{ENDED}")) == stored
        shutil.rmtree(folder.path)  # the next attempt runs on another machine
