"""The local folder of a job: staging in, what another machine needs, what a sweep may remove, and mishaps by name.

A remote storage is played by a local one that does not say where its files lie: every copy then really happens.
"""

import errno
import os
import time
from pathlib import Path

import pytest
import redis

from splatmill.backplane import keys, layout
from splatmill.backplane.storage import Storage, StorageError, StorageFullError
from splatmill.schema import Role
from splatmill_worker.errors import SfmFailed
from splatmill_worker.service import clean_up as sweep
from splatmill_worker.service import shared_cameras as reconstruction
from splatmill_worker.service import workspace
from splatmill_worker.service.problems import Transient, problem_of
from splatmill_worker.service.workspace import FolderInUseError, Mirror, ModelNotStored, Workspace, in_use

JOB, CAPTURE = "job00001", "capture1"


@pytest.fixture
def local(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Storage:
    monkeypatch.setenv("SPLATMILL_DATA", str(tmp_path / "data"))
    storage = Storage((tmp_path / "storage").as_uri())
    for name in ("a.jpg", "deep/b.jpg"):
        storage.put(layout.capture_file(CAPTURE, Role.images, name), name.encode())
    storage.put(layout.capture_file(CAPTURE, Role.masks, "a.png"), b"mask")
    return storage


@pytest.fixture
def remote(local: Storage) -> Storage:
    local.root = None
    return local


def staged(space: Workspace) -> dict[str, bytes]:
    files = [path for path in space.capture.rglob("*") if path.is_file()]
    return {path.relative_to(space.capture).as_posix(): path.read_bytes() for path in files}


EXPECTED = {"images/a.jpg": b"a.jpg", "images/deep/b.jpg": b"deep/b.jpg", "masks/a.png": b"mask"}


def test_a_local_capture_is_linked_and_outlives_its_deletion(local: Storage) -> None:
    space = Workspace(local, JOB, CAPTURE)
    assert space.stage_in() == 3
    assert (space.capture / "images/a.jpg").stat().st_nlink == 2
    local.delete_prefix(layout.capture(CAPTURE))
    assert staged(space) == EXPECTED


def test_a_remote_capture_is_copied(remote: Storage) -> None:
    space = Workspace(remote, JOB, CAPTURE)
    space.stage_in()
    assert staged(space) == EXPECTED


def test_what_left_the_capture_leaves_the_folder(local: Storage) -> None:
    space = Workspace(local, JOB, CAPTURE)
    space.stage_in()
    local.delete(layout.capture_file(CAPTURE, Role.images, "a.jpg"))
    space.stage_in()
    assert set(staged(space)) == set(EXPECTED) - {"images/a.jpg"}


def test_checkpoints_reach_an_attempt_on_another_machine(
    remote: Storage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    space = Workspace(remote, JOB, CAPTURE)
    for name in (
        "checkpoints/checkpoint.pt", "plan.json", "out/model.ply", "start.ply", "film/000.jpg", "film/.001.jpg.part",
    ):  # fmt: skip
        (space.run / name).parent.mkdir(parents=True, exist_ok=True)
        (space.run / name).write_text(name)
    warnings: list[str] = []
    Mirror(space, warnings.append).close(copy=True)
    assert warnings == []

    monkeypatch.setenv("SPLATMILL_DATA", str(tmp_path / "another machine"))
    there = Workspace(remote, JOB, CAPTURE)
    assert sorted(there.restore()) == ["checkpoints/checkpoint.pt", "film/000.jpg", "plan.json", "start.ply"]
    assert (there.run / "checkpoints/checkpoint.pt").read_text() == "checkpoints/checkpoint.pt"
    assert there.restore() == [], "what this machine has is newer"
    there.remove()
    assert not there.folder.exists()
    assert list(remote.entries(layout.job(JOB))) == []


@pytest.mark.parametrize("elsewhere", [True, False])
def test_a_run_begun_anew_gets_no_film_of_the_one_before(
    remote: Storage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, elsewhere: bool
) -> None:
    space = Workspace(remote, JOB, CAPTURE)
    for name in ("film/000.jpg", "plan.json"):
        (space.run / name).parent.mkdir(parents=True, exist_ok=True)
        (space.run / name).write_text(name)
    Mirror(space, lambda _: None).close(copy=True)
    if elsewhere:
        monkeypatch.setenv("SPLATMILL_DATA", str(tmp_path / "another machine"))
        space = Workspace(remote, JOB, CAPTURE)
    assert space.restore() == (["plan.json"] if elsewhere else [])
    stored = [entry.path for entry in remote.entries(layout.job_work(JOB))]
    assert stored == [f"{layout.job_work(JOB)}/plan.json"]


def test_recovered_cameras_serve_the_next_job_on_the_capture(remote: Storage, tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    whole, unfinished = first / "sfm/photos/model-1", first / "sfm/photos/model-2"
    for folder, names in ((whole, ("a.bin", "facts.json", "points3D.bin")), (unfinished, ("a.bin",))):
        folder.mkdir(parents=True)
        for name in names:
            (folder / name).write_text(name)
    (first / "sfm/photos/database.db").write_text("only of use while the cameras are being recovered")
    assert reconstruction.fetch(remote, CAPTURE, second) == 0
    assert reconstruction.share(remote, CAPTURE, first) == 1
    assert reconstruction.share(remote, CAPTURE, first) == 0
    assert reconstruction.fetch(remote, CAPTURE, second) == 1
    assert reconstruction.fetch(remote, CAPTURE, second) == 0
    files = [path.relative_to(second).as_posix() for path in second.rglob("*") if path.is_file()]
    assert sorted(files) == [f"sfm/photos/model-1/{name}" for name in ("a.bin", "facts.json", "points3D.bin")]
    # A copy that broke off before its last file is no model, and is completed by the next.
    (second / "sfm/photos/model-1/facts.json").unlink()
    assert reconstruction.fetch(remote, CAPTURE, second) == 1


def test_starting_over_keeps_the_cameras(local: Storage) -> None:
    space = Workspace(local, JOB, CAPTURE)
    for name in ("checkpoints/checkpoint.pt", "sfm/scene.json", "plan.json"):
        (space.run / name).parent.mkdir(parents=True, exist_ok=True)
        (space.run / name).write_text(name)
    space.start_over()
    assert [path.name for path in space.run.iterdir()] == ["sfm"]


def test_two_processes_never_share_a_folder(local: Storage, monkeypatch: pytest.MonkeyPatch) -> None:
    space = Workspace(local, JOB, CAPTURE)
    assert in_use(space.folder)
    monkeypatch.setattr(workspace, "LOCK_SECONDS", 0.1)
    with pytest.raises(FolderInUseError) as caught:
        Workspace(local, JOB, CAPTURE)
    with pytest.raises(Transient):
        problem_of(caught.value)


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


NO_PARALLAX = SfmFailed(
    "sfm_no_parallax", "The camera only turned.", {"parallax_deg": 0.2}, "Walk around the scene."
)


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (
            SfmFailed(
                "sfm_no_parallax", "The camera only turned.", {"parallax_deg": 0.2}, "Walk around the scene."
            ),
            "sfm_no_parallax",
        ),
        (MemoryError(), "out_of_memory"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), "out_of_memory"),
        (OSError(errno.ENOSPC, "No space left on device", "x"), "storage_full"),
        (OSError(errno.EFBIG, "File too large", "x"), "storage_full"),
        (PermissionError(errno.EACCES, "Permission denied", "x"), "storage_unwritable"),
        (StorageFullError("Storage is full: could not write x."), "storage_full"),
        (ZeroDivisionError("division by zero"), "internal_error"),
    ],
)
def test_every_mishap_has_a_name_and_advice(error: Exception, code: str) -> None:
    problem = problem_of(error)
    assert problem.code == code
    assert problem.advice


def test_a_named_failure_keeps_its_facts() -> None:
    assert problem_of(
        SfmFailed(
            "sfm_no_parallax", "The camera only turned.", {"parallax_deg": 0.2}, "Walk around the scene."
        )
    ).facts == {"parallax_deg": 0.2}


def test_numerical_failures_get_the_codes_of_the_wire() -> None:
    from splatmill_worker.errors import FailureName, TrainingFailed

    codes = {
        name: problem_of(TrainingFailed(name, "Something was seen.", step=7)).code for name in FailureName
    }
    assert codes == {
        FailureName.non_finite: "non_finite",
        FailureName.divergence: "diverged",
        FailureName.empty_scene: "empty_scene",
        FailureName.memory: "out_of_memory",
    }


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (StorageError("Storage could not read x: connection refused."), "storage_unavailable"),
        (redis.ConnectionError("Connection refused"), "queue_unavailable"),
        (redis.TimeoutError("Timeout reading from socket"), "queue_unavailable"),
    ],
)
def test_what_is_only_away_is_tried_again(error: Exception, code: str) -> None:
    with pytest.raises(Transient) as caught:
        problem_of(error)
    assert caught.value.problem.code == code


@pytest.mark.parametrize("where", ["local", "remote"])
def test_a_stored_model_is_brought_along_to_start_from(where: str, request: pytest.FixtureRequest) -> None:
    storage: Storage = request.getfixturevalue(where)
    storage.put(layout.model_file("model001", "model.ply"), b"splats")
    space = Workspace(storage, JOB, CAPTURE)
    space.stage_start("model001")
    storage.delete(layout.model_file("model001", "model.ply"))
    space.stage_start("model001")  # a later attempt; the model may be gone by now
    assert (space.run / "start.ply").read_bytes() == b"splats"
    assert not (space.run / "start.ply").is_symlink()
    space.start_over()
    for gone in ("model001", "../../etc"):
        with pytest.raises(ModelNotStored) as missing:
            space.stage_start(gone)
        assert problem_of(missing.value).code == "model_not_found"
    space.close()


def test_a_model_to_start_from_is_copied_where_links_cannot_be_made(
    local: Storage, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(source: Path, target: Path) -> None:
        raise OSError(errno.EXDEV, "Invalid cross-device link")

    monkeypatch.setattr(workspace.os, "link", refuse)  # storage on another file system than the work folder
    local.put(layout.model_file("model001", "model.ply"), b"splats")
    space = Workspace(local, JOB, CAPTURE)
    space.stage_start("model001")
    local.delete(layout.model_file("model001", "model.ply"))
    assert [path.name for path in space.run.iterdir()] == ["start.ply"]
    assert (space.run / "start.ply").read_bytes() == b"splats"
