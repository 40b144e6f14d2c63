"""Proves what a job's folder holds: the staged capture, and what an attempt elsewhere needs. One process has it.

The storage is a folder, the same folder as if it were a bucket, and a bucket (moto's server). Not proved here: the
bucket's own failures (tests/server/storage/test_bucket).
"""

import os
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.bucket import Patience
from splatmill.backplane.storage.errors import StorageUnreachableError
from splatmill.backplane.storage.storage import Storage, StorageError
from splatmill.schema import Role
from splatmill_worker.errors import CaptureIncomplete, FolderInUse, StartNotStored
from splatmill_worker.service import job_folder
from splatmill_worker.service.attempts import mirror, sfm_cache
from splatmill_worker.service.attempts.mirror import Mirror
from splatmill_worker.service.attempts.problems import is_transient, problem_of
from splatmill_worker.service.hand_back import HandedBack
from splatmill_worker.service.job_folder import JobFolder, hold
from splatmill_worker.service.room import Room
from splatmill_worker.service.staging import DOWNLOADS
from tests.support.jobs import CAPTURE
from tests.support.servers.faulty_s3 import FaultyS3, faulty_s3
from tests.support.waiting import wait_for

JOB, OTHER = "job00001", "job00002"


def staged(folder: JobFolder) -> dict[str, bytes]:
    files = [path for path in folder.capture.rglob("*") if path.is_file()]
    return {path.relative_to(folder.capture).as_posix(): path.read_bytes() for path in files}


EXPECTED = {"images/a.jpg": b"a.jpg", "images/deep/b.jpg": b"deep/b.jpg", "masks/a.png": b"mask"}


def test_a_local_capture_is_linked_and_outlives_its_deletion(local: Storage) -> None:
    folder = JobFolder(local, JOB, CAPTURE)
    assert folder.stage_capture() == 3
    assert (folder.capture / "images/a.jpg").stat().st_nlink == 2
    local.delete_prefix(layout.capture(CAPTURE))
    assert staged(folder) == EXPECTED


def test_a_remote_capture_is_copied(remote: Storage) -> None:
    folder = JobFolder(remote, JOB, CAPTURE)
    folder.stage_capture()
    assert staged(folder) == EXPECTED


PHOTOS = 3 * DOWNLOADS


@pytest.fixture
def bucket(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[FaultyS3, Storage]]:
    """Storage in a bucket, with photos in CAPTURE, and the proxy before it."""
    monkeypatch.setenv("SPLATMILL_DATA", str(tmp_path / "data"))
    with faulty_s3() as s3:
        storage = Storage(s3.storage, patience=Patience(answer=20.0, block=20.0, retries=0))
        for number in range(PHOTOS):
            storage.put(layout.capture_file(CAPTURE, Role.images, f"{number:02}.jpg"), b"%d" % number)
        yield s3, storage
        s3.release()


def test_files_come_from_a_bucket_several_at_a_time_and_their_number_is_told(
    bucket: tuple[FaultyS3, Storage],
) -> None:
    s3, storage = bucket
    folder, told = JobFolder(storage, JOB, CAPTURE), list[tuple[int, int]]()
    s3.fault = lambda request: "wait" if "/files/images" in request.path else None
    with ThreadPoolExecutor(1) as pool:
        staging = pool.submit(folder.stage_capture, lambda done, total: told.append((done, total)))
        wait_for(lambda: s3.stalled == DOWNLOADS)
        s3.fault = lambda _: None
        s3.release()
        assert staging.result(20) == PHOTOS
    assert staged(folder) == {f"images/{number:02}.jpg": b"%d" % number for number in range(PHOTOS)}
    assert told == [(done, PHOTOS) for done in range(1, PHOTOS + 1)]
    s3.requests.clear()
    folder.stage_capture()
    assert [request.path for request in s3.requests if "/files/images/" in request.path] == [], (
        "files that are present are not fetched"
    )


def test_a_staging_that_is_stopped_fetches_no_more_files(bucket: tuple[FaultyS3, Storage]) -> None:
    _, storage = bucket
    folder = JobFolder(storage, JOB, CAPTURE)

    def stop(done: int, total: int) -> None:
        raise HandedBack

    with pytest.raises(HandedBack):
        folder.stage_capture(stop)
    assert 1 <= len(staged(folder)) <= DOWNLOADS


def test_checkpoints_and_cameras_come_from_a_bucket_several_at_a_time(
    bucket: tuple[FaultyS3, Storage], tmp_path: Path
) -> None:
    s3, storage = bucket
    names = [f"film/{number:03}.jpg" for number in range(DOWNLOADS)] + ["checkpoints/ü b.pt"]
    for name in names:
        storage.put(f"{layout.job_work(OTHER)}/{name}", name.encode())
        storage.put(f"{layout.capture_sfm(CAPTURE)}/photos/model-1/{name}", name.encode())
    storage.put(f"{layout.capture_sfm(CAPTURE)}/photos/model-1/facts.json", b"{}")
    folder = JobFolder(storage, OTHER, CAPTURE)

    def at_once(action: Callable[[], object], path: str) -> object:
        s3.fault = lambda request: "wait" if request.method == "GET" and path in request.path else None
        with ThreadPoolExecutor(1) as pool:
            task = pool.submit(action)
            wait_for(lambda: s3.stalled == DOWNLOADS)
            s3.fault = lambda _: None
            s3.release()
            return task.result(20)

    assert at_once(folder.restore, "/work/film") == sorted(names)
    assert at_once(lambda: sfm_cache.fetch(storage, CAPTURE, folder.run), "/model-1/film") == 1
    for name in names:
        assert (folder.run / name).read_text() == name
        assert (folder.run / "sfm/photos/model-1" / name).read_text() == name
    assert not list(folder.path.rglob("*.part"))


def test_a_restoring_that_breaks_off_is_begun_anew(bucket: tuple[FaultyS3, Storage]) -> None:
    """Half of what an attempt stored would pass for all of it: a checkpoint without its plan."""
    s3, storage = bucket
    for name in ("checkpoints/checkpoint.pt", "plan.json"):
        storage.put(f"{layout.job_work(JOB)}/{name}", name.encode())
    folder = JobFolder(storage, JOB, CAPTURE)
    s3.fault = lambda request: 503 if request.path.endswith("plan.json") else None
    with pytest.raises(StorageUnreachableError):
        folder.restore()
    s3.fault = lambda _: None
    storage.put(f"{layout.job_work(JOB)}/checkpoints/checkpoint.pt", b"checkpoints/of later.....")
    assert folder.restore() == ["checkpoints/checkpoint.pt", "plan.json"]
    assert (folder.run / "checkpoints/checkpoint.pt").read_bytes() == b"checkpoints/of later....."
    assert (folder.run / "plan.json").is_file()


def test_a_file_that_the_bucket_does_not_give_ends_the_staging_by_name(
    bucket: tuple[FaultyS3, Storage],
) -> None:
    s3, storage = bucket
    s3.fault = lambda request: 503 if request.path.endswith("/03.jpg") else None
    with pytest.raises(StorageUnreachableError, match=r"could not read .*/03\.jpg"):
        JobFolder(storage, JOB, CAPTURE).stage_capture()


def test_the_checkpoint_is_copied_less_often_than_small_files_and_at_a_stop(
    room: Room, remote: Storage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mirror, "INTERVAL", 0.01)
    folder = JobFolder(remote, JOB, CAPTURE)
    work = layout.job_work(JOB)
    (folder.run / "checkpoints").mkdir(parents=True)
    (folder.run / "checkpoints/checkpoint.pt").write_text("1")
    copying = Mirror(folder, room, lambda _: None)
    wait_for(lambda: remote.exists(f"{work}/checkpoints/checkpoint.pt"))
    (folder.run / "checkpoints/checkpoint.pt").write_text("of later")
    # One after the other, so that a whole look lies between.
    (folder.run / "plan.json").write_text("{}")
    wait_for(lambda: remote.exists(f"{work}/plan.json"))
    (folder.run / "stages.json").write_text("{}")
    wait_for(lambda: remote.exists(f"{work}/stages.json"))
    assert remote.get(f"{work}/checkpoints/checkpoint.pt") == b"1"
    copying.close(copy=True)
    assert remote.get(f"{work}/checkpoints/checkpoint.pt") == b"of later"


def test_what_left_the_capture_leaves_the_folder(local: Storage) -> None:
    folder = JobFolder(local, JOB, CAPTURE)
    folder.stage_capture()
    local.delete(layout.capture_file(CAPTURE, Role.images, "a.jpg"))
    folder.stage_capture()
    assert set(staged(folder)) == set(EXPECTED) - {"images/a.jpg"}


def test_checkpoints_reach_an_attempt_on_another_machine(
    room: Room, remote: Storage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = JobFolder(remote, JOB, CAPTURE)
    for name in (
        "checkpoints/checkpoint.pt", "plan.json", "out/model.ply", "start.ply", "film/000.jpg", "film/.001.jpg.part",
    ):  # fmt: skip
        (folder.run / name).parent.mkdir(parents=True, exist_ok=True)
        (folder.run / name).write_text(name)
    warnings: list[str] = []
    Mirror(folder, room, warnings.append).close(copy=True)
    assert warnings == []

    monkeypatch.setenv("SPLATMILL_DATA", str(tmp_path / "another machine"))
    there = JobFolder(remote, JOB, CAPTURE)
    assert sorted(there.restore()) == ["checkpoints/checkpoint.pt", "film/000.jpg", "plan.json", "start.ply"]
    assert (there.run / "checkpoints/checkpoint.pt").read_text() == "checkpoints/checkpoint.pt"
    assert there.restore() == [], "what this machine has is newer"
    there.remove()
    assert not there.path.exists()
    assert list(remote.entries(layout.job(JOB))) == []


def test_a_checkpoint_that_storage_refuses_is_reported_and_copied_later(
    room: Room, remote: Storage, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = JobFolder(remote, JOB, CAPTURE)
    folder.run.mkdir()
    (folder.run / "plan.json").write_text("{}")
    warnings: list[str] = []
    copying = Mirror(folder, room, warnings.append)
    stored = f"{layout.job_work(JOB)}/plan.json"

    def refuse(path: str, data: object) -> None:
        raise StorageError(f"Storage could not write {path}: connection refused.")

    with monkeypatch.context() as away:
        away.setattr(remote, "put", refuse)
        copying.close(copy=True)
    assert len(warnings) == 1
    assert "plan.json" in warnings[0]
    assert not remote.exists(stored)
    copying.close(copy=True)
    assert len(warnings) == 1
    assert remote.get(stored) == b"{}"


@pytest.mark.parametrize("elsewhere", [True, False])
def test_a_run_begun_anew_gets_no_film_of_the_one_before(
    room: Room, remote: Storage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, elsewhere: bool
) -> None:
    folder = JobFolder(remote, JOB, CAPTURE)
    for name in ("film/000.jpg", "plan.json"):
        (folder.run / name).parent.mkdir(parents=True, exist_ok=True)
        (folder.run / name).write_text(name)
    Mirror(folder, room, lambda _: None).close(copy=True)
    if elsewhere:
        monkeypatch.setenv("SPLATMILL_DATA", str(tmp_path / "another machine"))
        folder = JobFolder(remote, JOB, CAPTURE)
    assert folder.restore() == (["plan.json"] if elsewhere else [])
    stored = [entry.path for entry in remote.entries(layout.job_work(JOB))]
    assert stored == [f"{layout.job_work(JOB)}/plan.json"]


def test_starting_over_keeps_the_cameras(local: Storage) -> None:
    folder = JobFolder(local, JOB, CAPTURE)
    for name in ("checkpoints/checkpoint.pt", "sfm/scene.json", "plan.json"):
        (folder.run / name).parent.mkdir(parents=True, exist_ok=True)
        (folder.run / name).write_text(name)
    folder.reset()
    assert [path.name for path in folder.run.iterdir()] == ["sfm"]


def test_two_processes_never_share_a_folder(local: Storage, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = JobFolder(local, JOB, CAPTURE)
    with hold(folder.path) as held:
        assert not held
    monkeypatch.setattr(job_folder, "LOCK_SECONDS", 0.1)
    with pytest.raises(FolderInUse) as caught:
        JobFolder(local, JOB, CAPTURE)
    assert is_transient(caught.value)
    assert problem_of(caught.value).code == "worker_lost"


def test_a_folder_that_is_removed_while_an_attempt_waits_for_it_is_made_anew(local: Storage) -> None:
    before = JobFolder(local, JOB, CAPTURE)
    (before.path / "old").touch()
    before.close()
    os.utime(before.path / "lock", (began := 1000.0, began))
    with hold(before.path) as held:
        assert held
        waiting = ThreadPoolExecutor(1).submit(JobFolder, local, JOB, CAPTURE)
        wait_for(lambda: (before.path / "lock").stat().st_mtime > began)
        shutil.rmtree(before.path)
    after = waiting.result(10)
    assert (after.path / "lock").is_file()
    assert not (after.path / "old").exists()
    with hold(after.path) as held:
        assert not held


@pytest.mark.parametrize("where", ["local", "remote"])
def test_a_stored_model_is_brought_along_to_start_from(where: str, request: pytest.FixtureRequest) -> None:
    storage: Storage = request.getfixturevalue(where)
    storage.put(layout.model_file("model001", "model.ply"), b"splats")
    folder = JobFolder(storage, JOB, CAPTURE)
    folder.stage_start("model001")
    storage.delete(layout.model_file("model001", "model.ply"))
    folder.stage_start("model001")  # a later attempt; the model may be gone by now
    assert (folder.run / "start.ply").read_bytes() == b"splats"
    assert not (folder.run / "start.ply").is_symlink()
    folder.reset()
    for gone in ("model001", "../../etc"):
        with pytest.raises(StartNotStored) as missing:
            folder.stage_start(gone)
        assert problem_of(missing.value).code == "model_not_found"
    folder.close()


def test_a_model_to_start_from_is_copied_where_links_cannot_be_made(elsewhere: Storage) -> None:
    elsewhere.put(layout.model_file("model001", "model.ply"), b"splats")
    folder = JobFolder(elsewhere, JOB, CAPTURE)
    folder.stage_start("model001")
    elsewhere.delete(layout.model_file("model001", "model.ply"))
    assert [path.name for path in folder.run.iterdir()] == ["start.ply"]
    assert (folder.run / "start.ply").read_bytes() == b"splats"


def test_a_capture_on_another_file_system_is_copied_and_outlives_its_deletion(elsewhere: Storage) -> None:
    folder = JobFolder(elsewhere, JOB, CAPTURE)
    assert folder.stage_capture() == 3
    assert not any(path.is_symlink() for path in folder.capture.rglob("*"))
    elsewhere.delete_prefix(layout.capture(CAPTURE))
    assert staged(folder) == EXPECTED


def test_links_that_an_earlier_version_staged_become_files(elsewhere: Storage) -> None:
    folder = JobFolder(elsewhere, JOB, CAPTURE)
    source = elsewhere.local_path(layout.capture_file(CAPTURE, Role.images, "a.jpg"))
    assert source is not None
    (folder.capture / "images").mkdir(parents=True)
    (folder.capture / "images/a.jpg").symlink_to(source)
    folder.stage_capture()
    assert not (folder.capture / "images/a.jpg").is_symlink()
    assert staged(folder) == EXPECTED


def test_a_stored_file_that_vanishes_while_it_is_staged_is_named(
    local: Storage, monkeypatch: pytest.MonkeyPatch
) -> None:
    listed = list(local.entries(layout.capture_files(CAPTURE)))
    monkeypatch.setattr(local, "entries", lambda prefix: listed)
    local.delete(layout.capture_file(CAPTURE, Role.images, "a.jpg"))
    with pytest.raises(CaptureIncomplete) as caught:
        JobFolder(local, JOB, CAPTURE).stage_capture()
    assert problem_of(caught.value).code == "capture_incomplete"
    assert caught.value.facts == {"missing": ["images/a.jpg"], "files": 3}
