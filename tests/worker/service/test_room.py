"""Proves that jobs store and unpack within their owner's quota, many at once too, and what they leave on the worker's
disk: nothing that was unpacked once a job is cancelled, also after a kill of the worker, and nothing of deleted jobs.

Does not prove the reservations themselves: tests/server/space/test_reservations.py does.
"""

import os
import signal
import threading
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import psutil
import pytest
import redis

from splatmill.backplane import keys, reservations
from splatmill.backplane.jobs.row import now
from splatmill.backplane.queue import queue
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import JobState, Role, StateEvent
from splatmill_worker.errors import QuotaReached
from splatmill_worker.images.archives import archive, unpacked_room
from splatmill_worker.service.abandoned_folders import remove_abandoned, tidy
from splatmill_worker.service.attempts.attempt import Attempt
from splatmill_worker.service.attempts.mirror import Mirror
from splatmill_worker.service.attempts.problems import is_transient, keeps_progress
from splatmill_worker.service.attempts.publish import publish
from splatmill_worker.service.job_folder import JobFolder
from splatmill_worker.service.lock import JobLock
from splatmill_worker.service.room import Room
from tests.support.jobs import CAPTURE, write_row
from tests.support.redis_server import RedisServer
from tests.support.up import running_worker, worker_environment
from tests.support.waiting import wait_for

JOB = "job00001"


@pytest.fixture
def limited(connection: redis.Redis) -> int:
    """The limit of the owner `default`."""
    reservations.note_limit(connection, "default", 100_000)
    return 100_000


def published(storage: Storage) -> int:
    return sum(entry.size for entry in storage.entries(layout.models()))


def test_of_many_jobs_that_end_at_once_those_are_stored_that_fit(
    local: Storage, connection: redis.Redis, limited: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("splatmill_worker.service.attempts.publish.RECORD_BYTES", 4096)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "model.ply").write_bytes(b"g" * 30_000)
    jobs = [f"job0000{number}" for number in range(8)]
    start, refused = threading.Barrier(len(jobs)), list[QuotaReached]()

    def end(job_id: str) -> bool:
        attempt = Attempt(connection, job_id, 1, 1, JobLock(connection, job_id, "token"))
        row = write_row(connection, job_id)
        start.wait()
        try:
            publish(local, attempt, row, tmp_path / "out", Room(connection, "default", job_id))
        except QuotaReached as error:
            refused.append(error)
            return False
        return True

    with ThreadPoolExecutor(len(jobs)) as pool:
        stored = list(pool.map(end, jobs))
    assert sum(stored) == 2
    assert {(error.code, keeps_progress(error), is_transient(error)) for error in refused} == {
        ("quota_exceeded", True, False)
    }
    assert 60_000 < published(local) <= limited
    assert reservations.used(connection, "default") <= limited


def test_a_restarted_job_needs_room_for_what_it_adds_only(
    connection: redis.Redis, limited: int, room: Room
) -> None:
    connection.hset(keys.stored("default"), f"model/{JOB}", '{"kind":"model","id":"x","bytes":60000}')
    connection.hset(keys.STORED_TOTALS, "default", 60_000)
    room.store_all({"model.ply": 90_000})
    assert reservations.used(connection, "default") == 90_000
    with pytest.raises(QuotaReached):
        room.store_all({"model.ply": 100_001})


def test_a_checkpoint_without_room_is_reported_and_not_copied(
    remote: Storage, limited: int, room: Room
) -> None:
    folder = JobFolder(remote, JOB, CAPTURE)
    place = folder.run / "checkpoints" / "state.pt"
    place.parent.mkdir(parents=True)
    place.write_bytes(b"c" * 100_001)
    warnings: list[str] = []
    Mirror(folder, room, warnings.append).close(copy=True)
    folder.close()
    assert [warning for warning in warnings if "state.pt could not be copied" in warning]
    assert list(remote.entries(layout.job_work(JOB))) == []


def test_files_that_are_stored_at_once_all_count(connection: redis.Redis, limited: int, room: Room) -> None:
    """Previews are stored while the files for other machines are."""
    start = threading.Barrier(8)

    def store(thread: int) -> None:
        start.wait()
        for number in range(20):
            room.store({f"{thread}/{number}": 100})

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(store, range(8)))
    assert reservations.used(connection, "default") == 8 * 20 * 100


def test_an_archive_is_unpacked_within_the_quota_of_the_owner(
    connection: redis.Redis, limited: int, room: Room, tmp_path: Path
) -> None:
    with zipfile.ZipFile(tmp_path / "set.zip", "w") as container:
        for number in range(3):
            container.writestr(f"{number}.jpg", os.urandom(20_000))
    with unpacked_room.claimed_by(room.unpack):
        archive.unpack(tmp_path / "set.zip", tmp_path / "first")
        assert reservations.used(connection, "default") == 60_000
        with pytest.raises(QuotaReached):
            archive.unpack(tmp_path / "set.zip", tmp_path / "second")
        unpacked_room.take("frames", 1_000_000, may_refuse=False)  # of a video, which are made already
    assert not list((tmp_path / "second").rglob("*.jpg"))
    assert reservations.used(connection, "default") == 1_060_000
    room.release_unpacked()
    assert reservations.used(connection, "default") == 0


def left(folder: JobFolder) -> set[str]:
    return {path.relative_to(folder.path).as_posix() for path in folder.path.rglob("*") if path.is_file()}


def filled(storage: Storage, job_id: str) -> JobFolder:
    """The folder that an attempt has left in the middle of its work."""
    folder = JobFolder(storage, job_id, CAPTURE)
    folder.stage_capture()
    for name in (
        "unpacked/a/1.jpg",
        "frames/b/1.jpg",
        "start.ply",
        "checkpoints/state.pt",
        "sfm/x/database.db",
    ):
        (folder.run / name).parent.mkdir(parents=True, exist_ok=True)
        (folder.run / name).write_bytes(b"x" * 1000)
    folder.close()
    return folder


KEPT = {"lock", "run/checkpoints/state.pt", "run/sfm/x/database.db"}


@pytest.mark.parametrize("how", ["cancelled", "failed", "deleted", "restarts"])
def test_what_is_made_anew_goes_with_the_end_of_the_job(
    local: Storage, connection: redis.Redis, how: str
) -> None:
    folder = filled(local, JOB)
    before = left(folder)
    connection.sadd(keys.ACTIVE, JOB)
    if how != "deleted":
        write_row(connection, JOB, **({"cancel_requested_at": now()} if how == "cancelled" else {}))
    if how == "failed":
        attempt = Attempt(connection, JOB, 1, 1, JobLock(connection, JOB, "token"))
        attempt.report(StateEvent(state=JobState.failed))
    tidy(connection, JOB)
    assert left(folder) == (before if how == "restarts" else KEPT)
    assert reservations.used(connection, "default") == (2000 if how in ("cancelled", "failed") else 0)


def test_maintenance_removes_what_dead_workers_have_left_and_counts_the_rest(
    local: Storage, connection: redis.Redis
) -> None:
    ended, waiting, deleted = (filled(local, name) for name in ("ended000", "waiting0", "deleted0"))
    before = left(waiting)
    for name in ("ended000", "waiting0"):
        write_row(connection, name)
    connection.sadd(keys.ACTIVE, "waiting0")
    connection.set(keys.deleting("model/deleted0"), keys.DELETED)
    assert remove_abandoned(connection) == ["deleted0"]
    assert not deleted.path.exists()
    assert left(ended) == KEPT
    assert left(waiting) == before
    assert reservations.used(connection, "default") == 2000
    remove_abandoned(connection)
    assert reservations.used(connection, "default") == 2000
    remove_abandoned(connection, keep=-1.0)
    assert not ended.path.exists()
    assert reservations.used(connection, "default") == 0


UNPACKING = '''
import time
from types import SimpleNamespace
from splatmill_worker.images import prepare
from splatmill_worker.images.archives import archive

def run(capture, workdir, options, emit, cancelled, *, onlookers=None):
    """Unpack the zip of the capture, and wait for ever."""
    prepare.unpacked("set.zip", capture / "images" / "set.zip", workdir, archive.Allowance(), cancelled)
    while not cancelled():
        time.sleep(0.05)
    return SimpleNamespace(ended="cancelled")
'''


@pytest.mark.slow
@pytest.mark.parametrize("killed", [False, True])
def test_a_cancelled_job_leaves_no_unpacked_file_also_when_its_worker_is_killed(
    redis_server: RedisServer, tmp_path: Path, killed: bool
) -> None:
    connection = redis_server.connection
    storage = Storage((tmp_path / "storage").as_uri())
    with zipfile.ZipFile(tmp_path / "set.zip", "w") as container:
        container.writestr("a.jpg", os.urandom(50_000))
    storage.put(layout.capture_file(CAPTURE, Role.images, "set.zip"), tmp_path / "set.zip")
    write_row(connection, JOB)
    connection.sadd(keys.ACTIVE, JOB)
    assert queue.enqueue(connection, JOB, 1)
    work = tmp_path / "data" / "work" / JOB
    (tmp_path / "unpacking.py").write_text(UNPACKING)
    environment = worker_environment(redis_server, storage, tmp_path, SPLATMILL_PIPELINE="unpacking")

    def unpacked() -> list[Path]:
        return [path for path in work.rglob("a.jpg") if ".partial" not in str(path)]

    def cancel() -> None:
        connection.hset(keys.job(JOB), "cancel_requested_at", now().isoformat())

    with running_worker(environment, may_end=killed) as first:
        wait_for(lambda: bool(unpacked()))
        assert reservations.used(connection, "default") == 50_000
        if killed:
            children = psutil.Process(first.pid).children(recursive=True)
            first.send_signal(signal.SIGKILL)
            psutil.wait_procs([*children], timeout=30)
            assert unpacked()
            cancel()
            connection.srem(keys.ACTIVE, JOB)  # the server has ended the job meanwhile
        else:
            cancel()
            while unpacked():
                queue.stop(connection, JOB, 1)
                time.sleep(0.1)
            wait_for(lambda: reservations.used(connection, "default") < 1000)
    if killed:
        with running_worker(environment):
            wait_for(lambda: not unpacked())
            wait_for(lambda: reservations.used(connection, "default") < 1000)
    assert not list(work.rglob("*.zip"))
