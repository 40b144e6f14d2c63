"""Atomic writes: a failed one leaves the old file and no part, and readers never see half a file.

Not proved: that `sync` survives a power cut; only that a failing sync leaves the old file.
"""

import os
import stat
from pathlib import Path

import pytest

from splatmill.files import atomic_write, move_into_place, replacing


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_the_new_file_takes_the_place_of_the_old(tmp_path: Path) -> None:
    target = tmp_path / "model.ply"
    atomic_write(target, b"old")
    atomic_write(target, "new: é", sync=True)
    assert target.read_text("utf-8") == "new: é"
    assert names(tmp_path) == ["model.ply"]


def test_the_old_file_is_there_until_the_block_ends(tmp_path: Path) -> None:
    target = tmp_path / "model.ply"
    target.write_bytes(b"old")
    with replacing(target) as part:
        part.write_bytes(b"new")
        assert target.read_bytes() == b"old"
        assert part.parent == tmp_path, "a rename is atomic within one file system only"
        assert part.name.startswith(".")
        assert part.name.endswith(".part")
    assert target.read_bytes() == b"new"


@pytest.mark.parametrize("failure", [OSError("disk full"), KeyboardInterrupt(), SystemExit(1)])
def test_a_failure_leaves_the_old_file_and_no_part(tmp_path: Path, failure: BaseException) -> None:
    target = tmp_path / "model.ply"
    target.write_bytes(b"old")

    def write_half() -> None:
        with replacing(target) as part:
            part.write_bytes(b"half of the n")
            raise failure

    with pytest.raises(type(failure)):
        write_half()
    assert target.read_bytes() == b"old"
    assert names(tmp_path) == ["model.ply"]


def test_a_failing_sync_leaves_the_old_file_and_no_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    target = tmp_path / "model.ply"
    target.write_bytes(b"old")
    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        atomic_write(target, b"new", sync=True)
    assert target.read_bytes() == b"old"
    assert names(tmp_path) == ["model.ply"]


def test_sync_covers_the_contents_before_the_rename_and_the_folder_after(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "model.ply"
    target.write_bytes(b"old")
    syncs: list[tuple[str, bytes]] = []

    def watch(descriptor: int) -> None:
        kind = "folder" if stat.S_ISDIR(os.fstat(descriptor).st_mode) else "file"
        syncs.append((kind, target.read_bytes()))

    monkeypatch.setattr("os.fsync", watch)
    atomic_write(target, b"new", sync=True)
    assert syncs == [("file", b"old"), ("folder", b"new")]


def test_a_block_that_writes_nothing_is_an_error(tmp_path: Path) -> None:
    target = tmp_path / "model.ply"
    target.write_bytes(b"old")
    with pytest.raises(FileNotFoundError), replacing(target):
        pass
    assert target.read_bytes() == b"old"


def test_two_writers_at_once_do_not_share_a_part(tmp_path: Path) -> None:
    target = tmp_path / "model.ply"
    with replacing(target) as first, replacing(target) as second:
        first.write_bytes(b"first")
        second.write_bytes(b"second")
    assert target.read_bytes() == b"first", "the inner block ends first"
    assert names(tmp_path) == ["model.ply"]


def test_parent_folders_are_created_and_the_longest_name_fits(tmp_path: Path) -> None:
    target = tmp_path / "a" / "b" / ("é" * 125 + ".ply")  # 254 bytes; file systems hold 255
    atomic_write(target, b"x")
    assert names(target.parent) == [target.name]


def test_the_file_has_the_permissions_of_any_new_file(tmp_path: Path) -> None:
    (tmp_path / "ordinary").write_bytes(b"x")
    atomic_write(tmp_path / "atomic", b"x")
    assert (tmp_path / "atomic").stat().st_mode == (tmp_path / "ordinary").stat().st_mode


def test_a_finished_part_moves_into_place(tmp_path: Path) -> None:
    part, target = tmp_path / "model.ply.part", tmp_path / "model.ply"
    part.write_bytes(b"whole")
    target.write_bytes(b"old")
    move_into_place(part, target, sync=True)
    assert target.read_bytes() == b"whole"
    assert names(tmp_path) == ["model.ply"]
