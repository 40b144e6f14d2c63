"""Proves what a job's folder holds: the staged capture, and what an attempt elsewhere needs. One process has it.

Does not prove that S3 works: tests/server/test_storage does where there is a bucket.
"""

import errno
import os
from pathlib import Path

import pytest

from splatmill.backplane import layout
from splatmill.backplane.storage import Storage
from splatmill.schema import Role
from splatmill_worker.errors import ModelNotStored
from splatmill_worker.service import workspace
from splatmill_worker.service.problems import Transient, problem_of
from splatmill_worker.service.workspace import FolderInUseError, Mirror, Workspace, in_use

JOB, CAPTURE = "job00001", "capture1"


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

    monkeypatch.setattr(os, "link", refuse)  # storage on another file system than the work folder
    local.put(layout.model_file("model001", "model.ply"), b"splats")
    space = Workspace(local, JOB, CAPTURE)
    space.stage_start("model001")
    local.delete(layout.model_file("model001", "model.ply"))
    assert [path.name for path in space.run.iterdir()] == ["start.ply"]
    assert (space.run / "start.ply").read_bytes() == b"splats"
