"""Proves that cameras recovered by one job serve the next one on the same capture, whole or not at all.

Does not prove that the names of the models tell different settings apart: tests/worker/sfm does.
"""

from pathlib import Path

from splatmill.backplane.storage.storage import Storage
from splatmill_worker.service.attempts import sfm_cache
from splatmill_worker.service.room import Room
from tests.support.jobs import CAPTURE


def test_recovered_cameras_serve_the_next_job_on_the_capture(
    room: Room, remote: Storage, tmp_path: Path
) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    whole, unfinished = first / "sfm/photos/model-1", first / "sfm/photos/model-2"
    for folder, names in ((whole, ("a.bin", "facts.json", "points3D.bin")), (unfinished, ("a.bin",))):
        folder.mkdir(parents=True)
        for name in names:
            (folder / name).write_text("{}" if name == "facts.json" else name)
    (first / "sfm/photos/database.db").write_text("only of use while the cameras are being recovered")
    assert sfm_cache.fetch(remote, CAPTURE, second) == 0
    assert sfm_cache.store(remote, CAPTURE, first, room) == 1
    assert sfm_cache.store(remote, CAPTURE, first, room) == 0
    assert sfm_cache.fetch(remote, CAPTURE, second) == 1
    assert sfm_cache.fetch(remote, CAPTURE, second) == 0
    files = [path.relative_to(second).as_posix() for path in second.rglob("*") if path.is_file()]
    assert sorted(files) == [f"sfm/photos/model-1/{name}" for name in ("a.bin", "facts.json", "points3D.bin")]
    # A copy that broke off before its last file is no model, and is completed by the next.
    (second / "sfm/photos/model-1/facts.json").unlink()
    assert sfm_cache.fetch(remote, CAPTURE, second) == 1


def test_cameras_whose_facts_are_damaged_are_not_used_and_replaced(
    room: Room, remote: Storage, tmp_path: Path
) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    model = "sfm/photos/model-1"
    for folder, facts in ((first, "{"), (second, '{"facts": {}}')):
        (folder / model).mkdir(parents=True)
        (folder / model / "facts.json").write_text(facts)
    assert sfm_cache.store(remote, CAPTURE, first, room) == 1
    assert sfm_cache.fetch(remote, CAPTURE, tmp_path / "third") == 0
    assert sfm_cache.store(remote, CAPTURE, second, room) == 1
    assert sfm_cache.fetch(remote, CAPTURE, tmp_path / "third") == 1
    assert (tmp_path / "third" / model / "facts.json").read_text() == '{"facts": {}}'
