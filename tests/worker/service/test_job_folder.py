"""Proves what a job's folder holds: the staged capture, and what an attempt elsewhere needs. One process has it.

Does not prove that S3 works: tests/server/test_storage does where there is a bucket.
"""

import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from splatmill.backplane import layout
from splatmill.backplane.storage import Storage, StorageError
from splatmill.schema import Role
from splatmill_worker.errors import CaptureIncomplete, FolderInUse, StartNotStored
from splatmill_worker.service import job_folder
from splatmill_worker.service.job_folder import JobFolder, hold
from splatmill_worker.service.mirror import Mirror
from splatmill_worker.service.problems import is_transient, problem_of
from tests.support.jobs import CAPTURE
from tests.support.waiting import wait_for

JOB = "job00001"


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


def test_what_left_the_capture_leaves_the_folder(local: Storage) -> None:
    folder = JobFolder(local, JOB, CAPTURE)
    folder.stage_capture()
    local.delete(layout.capture_file(CAPTURE, Role.images, "a.jpg"))
    folder.stage_capture()
    assert set(staged(folder)) == set(EXPECTED) - {"images/a.jpg"}


def test_checkpoints_reach_an_attempt_on_another_machine(
    remote: Storage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = JobFolder(remote, JOB, CAPTURE)
    for name in (
        "checkpoints/checkpoint.pt", "plan.json", "out/model.ply", "start.ply", "film/000.jpg", "film/.001.jpg.part",
    ):  # fmt: skip
        (folder.run / name).parent.mkdir(parents=True, exist_ok=True)
        (folder.run / name).write_text(name)
    warnings: list[str] = []
    Mirror(folder, warnings.append).close(copy=True)
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
    remote: Storage, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = JobFolder(remote, JOB, CAPTURE)
    folder.run.mkdir()
    (folder.run / "plan.json").write_text("{}")
    warnings: list[str] = []
    mirror = Mirror(folder, warnings.append)
    stored = f"{layout.job_work(JOB)}/plan.json"

    def refuse(path: str, data: object) -> None:
        raise StorageError(f"Storage could not write {path}: connection refused.")

    with monkeypatch.context() as away:
        away.setattr(remote, "put", refuse)
        mirror.close(copy=True)
    assert len(warnings) == 1
    assert "plan.json" in warnings[0]
    assert not remote.exists(stored)
    mirror.close(copy=True)
    assert len(warnings) == 1
    assert remote.get(stored) == b"{}"


@pytest.mark.parametrize("elsewhere", [True, False])
def test_a_run_begun_anew_gets_no_film_of_the_one_before(
    remote: Storage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, elsewhere: bool
) -> None:
    folder = JobFolder(remote, JOB, CAPTURE)
    for name in ("film/000.jpg", "plan.json"):
        (folder.run / name).parent.mkdir(parents=True, exist_ok=True)
        (folder.run / name).write_text(name)
    Mirror(folder, lambda _: None).close(copy=True)
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
